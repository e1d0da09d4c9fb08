"""How a map is optimised, as its user says it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt

from mapstream.operators.estimation.fixing import Fixable

Loss = Literal["huber", "cauchy", "geman_mcclure", "tukey", "squared"]
Refinable = Literal["extrinsics", "intrinsics", "time_offset"]


class OptimizeConfig(BaseModel):
    """How a map is optimised."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    solver: Literal["lm", "dogleg", "sparse"] = "lm"
    """`sparse` is a second implementation, on SciPy, of poses alone: for checks."""
    start: Literal["auto", "current", "chordal"] = "auto"
    """Where the poses begin; auto tries the chordal start where the current one ends in a contradiction."""
    start_landmarks: Literal["current", "mean"] = "current"
    """Where 3D points begin: where they are, or at the mean of all that was seen of them."""
    max_iterations: PositiveInt = 100
    """Of each descent; there are several where loops are switched."""
    max_seconds: PositiveFloat | None = None
    """No iteration begins after this time; the best so far is the result."""
    initial_lambda: PositiveFloat = 1e-5
    """The damping of the first iteration; the report of an earlier run has the one it ended with."""
    is_robust: bool = True
    """Switchable edges may be switched off."""
    gate_probability: float = Field(default=0.9999, gt=0, lt=1)
    """A switchable edge whose chi2 a true one stays below this often is false."""
    kinds: tuple[str, ...] | None = None
    """The kinds of edges that take part; left out, all do. Observations are `keypoints` and `points`."""
    without: tuple[str, ...] = ()
    """Kinds of edges that do not take part, and `keypoints` or `points`."""
    unanchored: Literal["join", "apart"] = "join"
    """Whether edges tie missions whose base frame is a guess to those where it is known; apart, they move none."""
    losses: dict[str, Loss] = {}
    """A robust loss by kind of edge, for instance `odometry: huber`; others are squared, but `keypoints` and `points`
    have huber from 3 sigma on."""
    loss_width: PositiveFloat = 1.0
    """Where losses begin to flatten, in units of where each usually does."""
    fix: tuple[Fixable, ...] = ()
    """What stays as it is: poses, velocities, biases, landmarks, frames (outer ones), extrinsics,
    extrinsics_rotation, extrinsics_translation, base_frames (of missions)."""
    refine: tuple[Refinable, ...] = ()
    """What is found of cameras: extrinsics, intrinsics, time_offset. The first stays near where it was measured."""
    refined_cameras: tuple[str, ...] = ()
    """Names of the cameras that `refine` is about; without, all."""
    max_reprojection_error_px: PositiveFloat = 50.0
    """Every third iteration observations beyond it, or behind their camera, leave, and those that fit come back."""
    underconstrained: Literal["error", "prior"] = "error"
    """What happens to variables that the edges do not determine: a weak prior holds them, or none."""
    reject_absolute: bool = False
    """Absolute measurements that contradict the others are switched off first."""
