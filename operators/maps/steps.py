"""Map tools one after another inside a graph: what is done to each map that comes.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-C ("a configurable set of operations").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeGuard, get_type_hints

import anyio
from pydantic import BaseModel, Field, ValidationError, model_validator

from mapstream.operators.maps.passing_clouds import PassingClouds
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload
from mapstream.recordings.maps.combine import with_journal_entry
from mapstream.recordings.maps.model import Map
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import Submap


class Tool(Protocol):
    """From a map to a new map and a report."""

    def __call__(self, map_: Map, folder: Path | None = None) -> tuple[Map, Any]:
        """Work on a map whose clouds are in a folder, where the tool needs them."""
        ...


TOOLS = {
    "anchor_missions": "mapstream.operators.places.anchoring:anchor_missions",
    "calibrate": "mapstream.operators.estimation.vision.calibration:calibrate",
    "close_semantic_loops": "mapstream.operators.objects.loops.closing:close_semantic_loops",
    "close_visual_loops": "mapstream.operators.places.loops:find_visual_loops",
    "compress_descriptors": "mapstream.operators.maps.descriptor_projections:compress_descriptors",
    "create_landmarks": "mapstream.operators.landmarks.create:create_landmarks",
    "evaluate_quality": "mapstream.operators.landmarks.quality:evaluate_quality",
    "find_places": "mapstream.operators.lidar.places.find_places:find_places",
    "fix_stationary": "mapstream.operators.maps.stationary:fix_stationary",
    "keyframe": "mapstream.operators.maps.keyframing:keyframe",
    "object_landmarks": "mapstream.operators.objects.landmarks.object_landmarks:object_landmarks",
    "optimize": "mapstream.operators.estimation.batch:optimize_map",
    "register": "mapstream.operators.lidar.constraints.register:register",
    "remove_bad_landmarks": "mapstream.operators.landmarks.removal:remove_bad_landmarks",
    "remove_invalid_observations": "mapstream.operators.landmarks.removal:remove_invalid_observations",
    "represent_objects": "mapstream.operators.objects.represent:represent_objects",
    "reset_quality": "mapstream.operators.landmarks.quality:reset_quality",
    "retriangulate": "mapstream.operators.landmarks.create:retriangulate",
    "summarize": "mapstream.operators.places.summary:summarize",
    "sparsify": "mapstream.operators.maps.sparsify:sparsify",
    "train_projection": "mapstream.operators.maps.descriptor_projections:train_projection",
}
"""By the name that graph files use; what is imported is imported when a graph uses it."""


class MapStep(OperatorConfig):
    """One tool and its options."""

    tool: str
    config: dict[str, Any] = Field(default_factory=dict)
    """As `mapstream map DIR TOOL --set` takes them."""

    @model_validator(mode="after")
    def _is_a_tool_with_its_options(self) -> MapStep:
        if self.tool not in TOOLS:
            raise ValueError(f"no map tool {self.tool!r}; there are {', '.join(sorted(TOOLS))}")
        try:
            prepared(self)
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"]))
            raise ValueError(f"{self.tool}: {key}: {first['msg']}") from error
        return self


class MapStepsConfig(OperatorConfig):
    """Options of `map_steps`."""

    steps: tuple[MapStep, ...] = Field(min_length=1)
    """In the order in which they are done."""


@dataclass(frozen=True)
class Inputs:
    """Maps as they grow, or one at the end."""

    maps: Receiver[Map]
    submaps: Receiver[Submap] | None = None  # for tools that need the clouds of keyframes


@dataclass(frozen=True)
class Outputs:
    """Each map after all steps."""

    maps: Sender[Map]


class MapSteps(Operator[Inputs, Outputs]):
    """Do the same steps to each map that comes; its journal tells them."""

    placement: ClassVar[Placement] = "process"  # gtsam holds the interpreter for its whole call
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: MapStepsConfig) -> None:
        self._steps = [(step, prepared(step)) for step in config.steps]

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        with PassingClouds() as clouds:
            async with anyio.create_task_group() as tasks:
                if inputs.submaps is not None:
                    tasks.start_soon(self._keep, inputs.submaps, clouds)
                async for map_ in inputs.maps:
                    if inputs.submaps is not None:
                        await clouds.wait_for(map_)
                    await outputs.maps.send(await offload(self.worked_on, map_, clouds))

    async def _keep(self, submaps: Receiver[Submap], clouds: PassingClouds) -> None:
        async for submap in submaps:
            await offload(clouds.keep, submap)
            clouds.tell()
        clouds.end()

    def worked_on(self, map_: Map, clouds: PassingClouds) -> Map:
        """Return the map after all steps.

        Raises:
            MappingError: If a tool refuses the map.
        """
        map_ = clouds.put_into(map_)
        for step, tool in self._steps:
            map_, _ = tool(map_, clouds.folder)
            map_ = with_journal_entry(map_, step.tool, **step.config)
        return clouds.taken_out(map_)


def prepared(step: MapStep) -> Tool:
    """Return the tool of a step with its options.

    Raises:
        ValidationError: If an option is not one.
    """
    tool, config_type = loaded(step.tool)
    if config_type is None:
        OperatorConfig.model_validate(step.config)
    else:
        tool = partial(tool, config=config_type.model_validate(step.config))
    takes_folder = "folder" in signature(tool).parameters

    def work(map_: Map, folder: Path | None = None) -> tuple[Map, Any]:
        return tool(map_, folder=folder) if takes_folder else tool(map_)

    return work


def loaded(name: str) -> tuple[Callable[..., tuple[Map, Any]], type[BaseModel] | None]:
    """Return the tool of this name and the type of its options, if it has any."""
    module, _, function = TOOLS[name].partition(":")
    tool = getattr(import_module(module), function)
    hint = get_type_hints(tool).get("config")
    types = (hint, *getattr(hint, "__args__", ()))
    return tool, next((found for found in types if _is_config(found)), None)


def _is_config(found: object) -> TypeGuard[type[BaseModel]]:
    return isinstance(found, type) and issubclass(found, BaseModel)
