"""The types of arrays, each defined once: numpy's by what they hold, tensors also by their shape.

In an annotation `Float[Tensor, "chain window time"]` is a tensor of floats with these dimensions, `"*batch time"` one
with any dimensions before time, `"*#batch"` one that broadcasts with all others of that name, `"window 3"` one whose
last dimension is three. A name stands for one length within a call. The tests check every such annotation of `vehicle`
and `inference` against the tensors passed (jaxtyping, beartype). Outside the tests it is `Annotated`: a type checker
reads `Tensor`, and it costs nothing.
"""

from __future__ import annotations

from typing import Annotated as Bool
from typing import Annotated as Complex
from typing import Annotated as Float
from typing import Annotated as Inexact
from typing import Annotated as Int
from typing import Annotated as Real

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bool", "BoolArray", "Complex", "Float", "FloatArray", "Inexact", "Int", "IntArray", "Real"]

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
