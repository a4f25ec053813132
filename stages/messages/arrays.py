"""Array types of messages: element type and shape in one place."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from runner.contract import Spec

Rgb = Annotated[NDArray[np.uint8], Spec("uint8", ("H", "W", 3))]
Depth = Annotated[NDArray[np.float32], Spec("float32", ("H", "W"))]
"""Metres along the optical axis; 0 where there is no reading."""
Mask = Annotated[NDArray[np.bool_], Spec("bool", ("H", "W"))]
Intrinsics = Annotated[NDArray[np.float64], Spec("float64", (3, 3))]
"""Pinhole matrix K, pixels, OpenCV convention (pixel centres at integer coordinates)."""
Pose = Annotated[NDArray[np.float64], Spec("float64", (4, 4))]
Poses = Annotated[NDArray[np.float64], Spec("float64", ("N", 4, 4))]
Points = Annotated[NDArray[np.float32], Spec("float32", ("N", 3))]
Vector = Annotated[NDArray[np.float64], Spec("float64", ("N",))]
Matrix = Annotated[NDArray[np.float64], Spec("float64", ("N", "M"))]
Box = Annotated[NDArray[np.float64], Spec("float64", (4,))]
"""Axis-aligned image box x0, y0, x1, y1 in pixels, x1 and y1 exclusive."""
