"""Trials: sealed cases answered by the diagnosis and by its rivals, resumable, scored alike."""

from avtorch.trial.answerers import RIVALS, avtorch, rivals
from avtorch.trial.reply import reply
from avtorch.trial.run import run_trial
from avtorch.trial.work import Answerer

__all__ = ["RIVALS", "Answerer", "avtorch", "reply", "rivals", "run_trial"]
