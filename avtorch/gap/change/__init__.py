"""What has changed between two sets of drives: the cause of a change, learnt on what both sets share."""
