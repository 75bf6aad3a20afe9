"""Which experiment next: the manoeuvre that separates causes that a log does not distinguish."""

from avtorch.experiment.manoeuvres import Limits, Manoeuvre, library
from avtorch.experiment.next_experiment import Experiment, next_experiment, write_table
from avtorch.experiment.prediction import Information as Information
from avtorch.experiment.prediction import ManoeuvrePrediction as ManoeuvrePrediction
from avtorch.experiment.prediction import information as information

__all__ = [
    "Experiment",
    "Limits",
    "Manoeuvre",
    "library",
    "next_experiment",
    "write_table",
]
