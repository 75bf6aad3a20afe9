"""How far the gap closes once the effect is added, on folds that chose neither it nor its parameters."""
