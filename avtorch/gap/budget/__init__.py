"""The budget of the gap: what each cause contributes to it, what is reproducible and unexplained, what is noise."""
