"""How far the gap closes once the effect is added, on folds used to select neither the effect nor its parameters."""
