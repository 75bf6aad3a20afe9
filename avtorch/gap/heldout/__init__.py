"""How far the gap shrinks once the effect is added, on parts of the drives that chose neither it nor its parameters."""
