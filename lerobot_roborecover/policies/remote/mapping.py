"""Mappings: which of our observations a server wants under which name, and what its actions mean.

A mapping is a YAML file, packaged (`mappings/`) or the user's own. Everything in it is checked when it is
read; `translate` then does as it says.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import draccus
import yaml

from lerobot_roborecover.policies.remote.errors import MappingError

VERSION = 1
_MAX_BYTES = 100_000


@dataclass(frozen=True)
class ImageEntry:
    """A camera picture of the server's observation."""

    source: str
    """Our key, such as `observation.images.image`."""
    key: str
    """The server's key."""
    under: str = ""
    """Key of the map that holds it, where the server wants pictures in a map of their own."""
    flip: Literal["none", "horizontal", "vertical", "rotate_180"] = "none"
    """Applied to our picture, which has LeRobot's orientation: upright on RoboTwin and Meta-World; on LIBERO
    robosuite's raw picture turned by 180 degrees, as the public data sets have it."""
    size: tuple[int, int] | None = None
    """(height, width) in pixels; None sends what was rendered."""
    resize: Literal["pad", "stretch"] = "pad"
    """`pad` keeps the aspect ratio and fills with black, as openpi's `resize_with_pad` does."""
    layout: Literal["hwc", "chw"] = "hwc"
    dtype: Literal["uint8", "float32"] = "uint8"
    """`uint8` from 0 to 255, or `float32` from 0 to 1."""
    batch_axis: bool = False
    """Whether the server wants a first axis of length 1."""
    time_axis: bool = False
    """Whether the steps of the window are an axis, after the batch's (GR00T)."""
    when: tuple[str, ...] = ()
    """Observation parameters that the server must have asked for: `name`, or `not name` (vla-eval)."""


@dataclass(frozen=True)
class StatePart:
    """A run of numbers of one of our state vectors."""

    source: str = "observation.state"
    """Our key."""
    slice: tuple[int, int] | None = None
    """First index, and one past the last; None takes all."""
    convert: Literal["none", "axis_angle_to_quat_xyzw", "axis_angle_to_pi"] = "none"
    """Axis-angle keeps the sign of robosuite's quaternion (an angle from 0 to 2 pi), so that the quaternion
    inverts LeRobot's conversion; `axis_angle_to_pi` is the same rotation by at most pi."""

    def __post_init__(self):
        if self.slice is not None and not 0 <= self.slice[0] < self.slice[1]:
            raise MappingError(f"slice {list(self.slice)} of {self.source}: needs 0 <= first < end")
        if self.convert != "none" and (self.slice is None or self.slice[1] - self.slice[0] != 3):
            raise MappingError(f"convert {self.convert} of {self.source}: needs a slice of three numbers")


@dataclass(frozen=True)
class StateEntry:
    """A vector of the server's observation: our parts in the order given."""

    key: str
    parts: tuple[StatePart, ...]
    under: str = ""
    dtype: Literal["float32", "float64"] = "float32"
    batch_axis: bool = False
    time_axis: bool = False
    """As of a picture."""
    when: tuple[str, ...] = ()
    """As of a picture."""

    def __post_init__(self):
        if not self.parts:
            raise MappingError(f"state {self.key!r} has no parts")


@dataclass(frozen=True)
class Prompt:
    """Where the instruction goes."""

    key: str = "prompt"
    under: str = ""
    """Key of the map that holds it."""
    as_list: bool = False
    """Whether the server wants a list of one string."""
    batch_axis: bool = False
    """Whether it wants that in a list again."""
    lower: bool = False


@dataclass(frozen=True)
class Window:
    """Observations of the last steps, oldest first; the first one of a trial is repeated until there are
    enough."""

    frames: int
    key: str = ""
    """Key of a list of maps, into which pictures and states go; empty: they are the entries' time axis."""

    def __post_init__(self):
        if not 1 <= self.frames <= 64:
            raise MappingError(f"window frames={self.frames}: must be from 1 to 64")


@dataclass(frozen=True)
class Gripper:
    """What the server's gripper column becomes. Ours on LIBERO: -1 opens, +1 closes."""

    column: int
    """Column of the actions as executed; -1 is the last."""
    threshold: float | None = None
    """With it, values above become `above` and others `below`, before `scale` and `offset`."""
    above: float = 1.0
    below: float = -1.0
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Joined:
    """Actions that come in parts."""

    keys: tuple[str, ...]
    """Keys of arrays (n, A_i), put side by side."""
    columns: tuple[int, ...]
    """Columns of all of them together, in our order."""

    def __post_init__(self):
        if not self.keys or min(self.columns, default=-1) < 0:
            raise MappingError("actions joined: needs keys, and columns from 0")


@dataclass(frozen=True)
class ActionEntry:
    """The server's answer."""

    key: str = "actions"
    """Key of an array (n, A)."""
    joined: Joined | None = None
    """Where the answer has no `key`."""
    columns: tuple[int, ...] | None = None
    """Columns executed, in our order; None takes all."""
    execute: int | None = None
    """Actions executed before the server is asked again; None executes all that it gives."""
    scale: tuple[float, ...] | None = None
    """Factor per executed column."""
    offset: tuple[float, ...] | None = None
    """Added per executed column, after `scale`."""
    gripper: tuple[Gripper, ...] = ()
    """Applied last."""

    def __post_init__(self):
        if self.execute is not None and not 1 <= self.execute <= 10_000:
            raise MappingError(f"actions execute={self.execute}: must be from 1 to 10000")
        widths = {len(v) for v in (self.columns, self.scale, self.offset) if v is not None}
        if len(widths) > 1:
            raise MappingError(f"actions columns, scale and offset have different lengths: {sorted(widths)}")
        if self.columns is not None and min(self.columns, default=-1) < 0:
            raise MappingError(f"actions columns={list(self.columns)}: must be indices from 0, at least one")


@dataclass(frozen=True)
class ResetMessage:
    """What a server with a history must be told before a trial's first request, and after a reconnection."""

    message: dict[str, Any]


@dataclass(frozen=True)
class Specs:
    """What is given and taken, in the words of a server that declares its own (vla-eval's `DimSpec`)."""

    action: dict[str, str] = field(default_factory=dict)
    """Format by component."""
    observation: dict[str, str] = field(default_factory=dict)
    """Format by component."""


@dataclass(frozen=True)
class Mapping:
    """One server's interface."""

    version: int
    """Version of this format."""
    about: str
    """What the mapping speaks to, in a line."""
    protocol: Literal["openpi", "vla_eval", "gr00t"] = "openpi"
    """How the server is spoken to."""
    argument: str = "observation"
    """Under which name `get_action` takes the observation; empty: it takes nothing else (GR00T N1.5)."""
    specs: Specs = field(default_factory=Specs)
    """Compared with what the server declares (vla-eval)."""
    episode: dict[str, Any] = field(default_factory=dict)
    """Said of the task at every episode's start, beside its instruction (vla-eval)."""
    native: bool = False
    """Whether the server is `roborecover serve`: observations go under our own keys, each trial has its
    session, and the server draws its noise from the trial's seed."""
    render: tuple[int, int] | None = None
    """(height, width) of the pictures that the server's own client takes; others bring a warning."""
    images: tuple[ImageEntry, ...] = ()
    state: tuple[StateEntry, ...] = ()
    prompt: Prompt = field(default_factory=Prompt)
    constants: dict[str, Any] = field(default_factory=dict)
    """Sent as they are with every request."""
    window: Window | None = None
    reset: ResetMessage | None = None
    actions: ActionEntry = field(default_factory=ActionEntry)

    def __post_init__(self):
        if self.version != VERSION:
            raise MappingError(f"version {self.version}: this RoboRecover reads version {VERSION}")
        if self.native and (self.images or self.state or self.window or self.reset or self.constants):
            raise MappingError("native: true takes no images, state, window, reset or constants")
        if not self.native and not (self.images or self.state):
            raise MappingError("sends nothing: give images or state (or native: true for roborecover serve)")
        if self.protocol == "vla_eval" and (self.native or self.window or self.reset):
            raise MappingError("protocol: vla_eval takes no native, window or reset")
        if self.protocol == "gr00t" and self.native:
            raise MappingError("protocol: gr00t takes no native")
        timed = [e.key for e in (*self.images, *self.state) if e.time_axis]
        if self.window and bool(self.window.key) == bool(timed):
            raise MappingError(
                "window: give its key, for a list of maps, or the time_axis of the pictures and states"
            )
        keys = [(e.under, e.key, *e.when) for e in (*self.images, *self.state)]
        keys += [("", k) for k in self.constants]
        keys += [(self.prompt.under, self.prompt.key)] + (
            [("", self.window.key)] if self.window and self.window.key else []
        )
        twice = sorted({"/".join(filter(None, k[:2])) for k in keys if keys.count(k) > 1})
        if twice:
            raise MappingError(f"server keys given twice: {twice}")


def packaged_mappings() -> list[str]:
    """Names of the mappings that come with RoboRecover."""
    folder = files(__package__).joinpath("mappings")
    return sorted(p.name.removesuffix(".yaml") for p in folder.iterdir() if p.name.endswith(".yaml"))


def load_mapping(name: str) -> Mapping:
    """A mapping by packaged name or path.

    Args:
        name: such as `openpi_libero`, or a path that ends in `.yaml` or `.yml`.

    Raises:
        MappingError: it does not exist or cannot be used, with the file and the place in it.
    """
    if name.endswith((".yaml", ".yml")):
        path = Path(name)
        if not path.is_file():
            raise MappingError(f"--policy.mapping={name}: no such file")
        if path.stat().st_size > _MAX_BYTES:
            raise MappingError(f"{name}: {path.stat().st_size} bytes; a mapping has at most {_MAX_BYTES}")
        text = path.read_text(encoding="utf-8", errors="replace")
    elif name in packaged_mappings():
        text = files(__package__).joinpath("mappings", f"{name}.yaml").read_text(encoding="utf-8")
    else:
        raise MappingError(
            f"--policy.mapping={name or '(none)'}: neither one of {packaged_mappings()} nor a path to a "
            ".yaml file"
        )
    return parse_mapping(text, name)


def parse_mapping(text: str, name: str) -> Mapping:
    """A mapping from YAML text.

    Args:
        text: YAML.
        name: of the file, for errors.

    Raises:
        MappingError: with the place in the file.
    """
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as err:
        raise MappingError(f"{name}: not YAML: {err}") from err
    if not isinstance(content, dict):
        raise MappingError(f"{name}: a mapping is a YAML map, not {type(content).__name__}")
    try:
        return draccus.decode(Mapping, content)
    except MappingError as err:
        raise MappingError(f"{name}: {err}") from err
    except draccus.utils.DecodingError as err:
        cause = err.__cause__ or err.__context__
        if isinstance(cause, MappingError):
            raise MappingError(f"{name}: {cause}") from err
        raise MappingError(f"{name}: {' '.join(str(err).split())}") from err
