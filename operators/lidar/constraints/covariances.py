"""What an aligned pair of clouds is worth: a fixed covariance for each sensor and method, from a table.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-D.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError
from mapstream.streams.fields import Fields

TABLE = Path(__file__).with_name("covariances.yaml")


def fixed_covariance(sensor: str, method: str, table: Path | None = None) -> FloatArray:
    """Return the covariance (6, 6) of a pose that a method finds from a sensor's clouds, rotation first.

    Args:
        sensor: As the table calls it.
        method: The name of a registration.
        table: A YAML file like `covariances.yaml`; that one without.

    Raises:
        ConfigError: If the table cannot be read, or has no such row.
    """
    path = table or TABLE
    known = []
    for row in Fields.of_file(path).items("covariances"):
        name = (row.text("sensor"), row.text("method"))
        if name == (sensor, method):
            sigmas = row.number("rotation_sigma_rad"), row.number("translation_sigma_m")
            if min(sigmas) <= 0:
                raise row.error("rotation_sigma_rad", "expected standard deviations above 0")
            return np.diag(np.square(np.repeat(sigmas, 3)))
        known.append("/".join(name))
    raise ConfigError(
        f"{path.name}: no covariance for the sensor {sensor!r} and the method {method!r}; known are"
        f" {', '.join(known)}; give a table of your own, or covariance: hessian"
    )
