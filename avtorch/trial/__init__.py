"""Trials: sealed cases answered by the diagnosis and by its rivals, resumable, scored alike."""

from avtorch.trial.answerers import RIVALS, avtorch, rivals
from avtorch.trial.background import SIZES, run_background
from avtorch.trial.reply import reply
from avtorch.trial.run import run_trial
from avtorch.trial.work import Answerer

__all__ = ["RIVALS", "SIZES", "Answerer", "avtorch", "reply", "rivals", "run_background", "run_trial"]
