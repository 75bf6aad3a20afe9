"""The search for the hypotheses that explain a log best: effects, pairs, onsets and random effects."""
