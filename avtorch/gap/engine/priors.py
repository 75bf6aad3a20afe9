"""Priors of the engine with their unit and source, odds in nats, and the resolution of its coefficients.

Probabilities come from evidence, tempered by `TEMPER`. Grids, priors of random forces and tolerances of numerical work
stand in the files that use them.
"""

from __future__ import annotations

TEMPER = 0.25
"""Power of the likelihood in the model average [-]. Coefficients of neighbouring frames and bins are not independent,
and no equation is exact (SafeBayes; Grünwald and van Ommen 2017). Chosen on simulated logs."""

EFFECT_NATS = 10.0
"""What the presence of one more effect costs before tempering [nats]: prior odds of exp(-2.5), one in twelve."""
EFFECT_NATS_ALONE = 6.0
"""The same with one channel [nats]: below `ONE_CHANNEL_HZ` there are tens of times fewer coefficients to be wrong
in."""
SLOW_FORCE_NATS = 7.0
"""The same for a slow random force (gust, road) [nats]: any drive meets some wind and slope."""
UNKNOWN_NATS = 14.0
"""The same for a free form in place of a name [nats]: ten forms at exp(-3.5) each are a sixth of what 25 names have."""
OUTLIER_NATS = 18.0
"""The same for outliers [nats]: tails compare the best of many laws."""
TRIED_NATS = 3.2
"""What one more effect must gain for the search to go on from there [nats]: odds of one in 25. Lower than
`EFFECT_NATS`, so that the average sees what is around its best sets."""
WITHIN_NATS = 25.0
"""What is this far behind the best set is not examined [nats]: odds of one in 500 after tempering."""
SHIFT_NATS = 3.0
"""A speed at which gears shift [nats]: one of some twenty places along the range of speeds."""
ONSET_ODDS = 1 / 3
"""Probability that an effect that may set in during a drive did so [-]; when, one of as many times as there are
frames."""
LOST_S = 1.4
"""Longest stretch of lost messages [s]: a link that is silent for longer has timed out, and the controller with it. The
price of a stretch follows, see `evidence.lost_nats`."""

SHAPE_ERROR = 0.06
"""Relative error of a named effect's response [-], half-normal: a table's equation is not quite the car's."""
SHAPE_ERROR_FOUND = 0.2
"""The same where the effect's times were found one by one in the log (lost messages) [-]."""

SCALE_OF_RANGE = 0.6
"""Scale of an effect's prior, Student t with three degrees of freedom, over the far end of its typical range [-]."""
FAINT_OF_RANGE = 0.3
"""Faint size of an effect, over the near end of its typical range [-] (a third of the far end where it has a sign): the
prior vanishes there as exp(-(faint / size)²), a non-local prior (Johnson and Rossell 2010). A fainter one has a name
only where a long drive pays for it."""

MAP_SIZE = (0.2, 1.2)
"""Relative size of a car's force beyond K u over the demanded acceleration [-], log-normal by mean and standard
deviation of the logarithm: pedal maps, brakes and tyres bend by a tenth to a half of what is asked for."""
FAINT_MAP = 0.05
"""Relative size [-] at which a force map is none: the prior vanishes there as exp(-(faint / size)²), as that of a named
effect does; a car with a true command is linear to some per cent."""

RECORDER_DELAY_S = {"accel": (0.0, 0.0075), "speed": (0.01, 0.01)}
"""Mean and standard deviation of a recorder's delay [s]: buses and clocks of channels, up to 20 ms."""
RECORDER_FILTER_S = {"accel": (0.015, 0.0125), "speed": (0.03, 0.0175)}
"""Mean and standard deviation of its one-pole filter [s]; 20 to 80 ms are usual."""

CLAIM_HZ = 10.0
"""Cars answer below this frequency [Hz]; above it a closed loop leaves echoes of noise that recorders shift."""
SLOW_HZ = 2.0
"""Below this frequency [Hz] both channels show a slow force alike."""
ONE_CHANNEL_HZ = 1.3
"""With one channel nothing above this frequency [Hz] tells the car's delays from the recorder's."""

WARM_S = 4.0
"""Start of each stretch that is simulated but not scored [s]: transients of lag and delay have died out."""
FRAME_S = (4.0, 10.0)
"""Shortest and longest frame of the lapped transform [s]: long against lags, short against a drive."""
BAND_RATIO = 1.22
"""Ratio of a band's ends [-]: noise spectra are smooth over a third of an octave."""
