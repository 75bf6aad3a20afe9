"""Which experiment next: the manoeuvre that separates causes that a log does not distinguish."""

from avtorch.experiment.manoeuvres import Limits, Manoeuvre, library
from avtorch.experiment.next_experiment import Experiment, next_experiment, write_table
from avtorch.experiment.prediction import Information as Information
from avtorch.experiment.prediction import ManoeuvrePrediction as ManoeuvrePrediction
from avtorch.experiment.prediction import information as information
from avtorch.experiment.ranking import RankAgreement, rank_agreement

__all__ = [
    "Experiment",
    "Limits",
    "Manoeuvre",
    "RankAgreement",
    "library",
    "next_experiment",
    "rank_agreement",
    "write_table",
]
