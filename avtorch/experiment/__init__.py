"""Which experiment next: the manoeuvre that separates causes that a log does not distinguish."""

from avtorch.experiment.information import Information, information
from avtorch.experiment.limits import Limits
from avtorch.experiment.manoeuvres import Manoeuvre, library
from avtorch.experiment.next_experiment import Experiment, next_experiment, write_table
from avtorch.experiment.prediction import ManoeuvrePrediction

__all__ = [
    "Experiment",
    "Information",
    "Limits",
    "Manoeuvre",
    "ManoeuvrePrediction",
    "information",
    "library",
    "next_experiment",
    "write_table",
]
