"""Which registration aligns clouds, and how finely: options that all who align share."""

from __future__ import annotations

from typing import Any

from pydantic import Field, PositiveFloat

from mapstream.operators.lidar.registration import Registration, make_registration
from mapstream.operators.operator import OperatorConfig


class AligningConfig(OperatorConfig):
    """How clouds are aligned."""

    registration: str = "gicp"
    """How clouds are aligned: icp, plane, gicp, vgicp, or an installed registration."""
    registration_options: dict[str, Any] = Field(default_factory=dict)
    """Options of an installed registration."""
    voxel_size_m: PositiveFloat = 0.25
    """Of the clouds that are aligned."""
    search_distances_m: tuple[PositiveFloat, ...] = (1.0, 0.4)
    """How far apart matching points may lie, coarse to fine."""
    inlier_distance_m: PositiveFloat = 0.1
    """How far from the surface a point may lie to count as an inlier."""

    def make_registration(self, coarseness: float = 1.0) -> Registration:
        """Return the registration; a coarser one has larger voxels and searches farther.

        Raises:
            ConfigError: If there is none of this name.
        """
        return make_registration(
            self.registration,
            self.registration_options,
            leaf_size_m=coarseness * self.voxel_size_m,
            search_distances_m=tuple(coarseness * d for d in self.search_distances_m),
            inlier_distance_m=self.inlier_distance_m,
        )
