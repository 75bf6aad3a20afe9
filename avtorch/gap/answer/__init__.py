"""What is said of them: probabilities, `unknown`, alias sets, posteriors, the verdict."""
