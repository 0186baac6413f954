"""Names of the array types that functions take and give."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Floats = NDArray[np.float32]
