"""What an answer is made of: causes and their probabilities, the budget, where the gap lies, what has changed."""
