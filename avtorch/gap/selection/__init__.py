"""Which hypothesis a log supports: probabilities, adequacy, alias sets, the verdict."""
