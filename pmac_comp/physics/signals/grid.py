"""Samples brought onto the finer grid of the servo.

What lives here: interpolation in time. What may not: decisions about which samples count.
"""

import numpy as np
from scipy.interpolate import make_interp_spline

from pmac_comp.base.arrays import FloatArray


def onto_servo_grid(values: FloatArray, stride: int) -> FloatArray:
    """Samples taken every ``stride`` servo cycles at every cycle, by a cubic spline.

    Lines between the samples of a command would have corners, and each corner a pulse of
    acceleration that the drive never saw.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Finite samples.
    stride : int
        Servo cycles per sample.

    Returns
    -------
    ndarray, shape ((n - 1) * stride + 1,)
    """
    if stride == 1:
        return np.ascontiguousarray(values)
    coarse = stride * np.arange(values.size, dtype=np.float64)
    fine = np.arange(stride * (values.size - 1) + 1, dtype=np.float64)
    return np.asarray(make_interp_spline(coarse, values, k=min(3, values.size - 1))(fine))
