"""The whole configuration: frozen dataclasses; defaults < the log's own description < YAML file < command line.

An unknown key is an error that names the nearest known one. Field docstrings are what ``dgorl config`` prints.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, UnionType
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from dgorl.errors import ConfigurationError, brief
from dgorl.plain_yaml import PlainYamlError, plain_yaml

Kernel = Literal["none", "huber", "cauchy", "huber_negative", "cauchy_negative"]
Solver = Literal["native", "g2o", "gtsam"]
Clock = Literal["shared", "estimated"]

NOISE = (
    "heading_per_second",
    "heading_per_radian",
    "heading_per_metre",
    "forward_per_metre",
    "lateral_per_metre",
    "position_per_second",
    "predicted_speed_sigma",
    "predicted_turn_rate_sigma",
)
"""Settings of ``Motion`` that are standard deviations."""
LONGEST_WORD = 80
"""of what is compared with known words, so that comparing costs nothing"""


@dataclass(frozen=True)
class Motion:
    """Odometry: what the wheels say and how far to trust it (METHOD §1)."""

    linear_scale: float = 1.0
    """true forward speed = linear_scale × reported"""
    angular_scale: float = 1.0
    """true turn rate = angular_scale × reported"""
    lag: float = 0.0
    """the body follows the reported twist this much later [s]"""
    heading_per_second: float = 0.007
    """heading σ after one second [rad/√s]"""
    heading_per_radian: float = 0.10
    """heading σ after turning one radian [rad/√rad]"""
    heading_per_metre: float = 0.04
    """heading σ after one metre [rad/√m]"""
    forward_per_metre: float = 0.06
    """forward σ after one metre [m/√m]"""
    lateral_per_metre: float = 0.02
    """sideways σ after one metre [m/√m]"""
    position_per_second: float = 0.003
    """position σ after one second, moving or not [m/√s]"""
    maximum_speed: float = 1.0
    """a robot without odometry for a while moves at most this fast [m/s]"""
    maximum_turn_rate: float = 2.0
    """... and turns at most this fast [rad/s]"""
    predicted_speed_sigma: float = 0.2
    """σ of the speed a late robot is predicted with until its own odometry has taught how it drives [m/s]"""
    predicted_turn_rate_sigma: float = 0.5
    """... and of its turn rate [rad/s]"""
    stated_covariance: bool = True
    """take the covariance odometry states of itself, where it does; false: the rates above"""


@dataclass(frozen=True)
class Radio:
    """Signal strength: RSSI(d) = A − 10 η log10(d) + N(0, σ_dB²) (METHOD §2)."""

    rssi_at_1m_dbm: float = -40.0
    """A: expected RSSI at one metre [dBm]"""
    path_loss_exponent: float = 3.0
    """η, 2 (free space) to 6 (complex indoor)"""
    sigma_db: float = 2.0
    """σ_dB: shadowing [dB]"""
    reciprocity: float = 0.0
    """correlation ρ of the two directions of a link, 0 to 1"""
    kernel: Kernel = "none"
    """robust kernel; the one-sided ones distrust weak readings alone: one that is far too strong they believe"""
    width: float = 2.0
    """kernel width [σ]"""
    thinning: float = 0.0
    """one reading per direction and this many seconds; 0 takes all"""


@dataclass(frozen=True)
class Ranging:
    """Ranges: range_true = scale · reported + offset, σ(d) = sigma + sigma_per_metre · d (METHOD §2)."""

    scale: float = 1.0
    """multiplies the reported range"""
    offset: float = 0.0
    """added after scaling [m]"""
    sigma: float | None = None
    """σ at zero distance [m]; null takes each measurement's own"""
    sigma_per_metre: float = 0.0
    """growth of σ with distance [m/m]; used with sigma"""
    kernel: Kernel = "cauchy"
    """robust kernel; the one-sided ones distrust long ranges alone: one that is far too short they believe"""
    width: float = 2.0
    """kernel width [σ]"""
    thinning: float = 0.0
    """one range per pair and this many seconds; 0 takes all"""


@dataclass(frozen=True)
class Bearings:
    """Bearings: bearing_true = reported + offset."""

    offset: float = 0.0
    """added to the reported bearing [rad]"""
    sigma: float | None = None
    """σ [rad]; null takes each measurement's own"""
    kernel: Kernel = "huber"
    """robust kernel"""
    width: float = 2.0
    """kernel width [σ]"""
    thinning: float = 0.0
    """one bearing per direction and this many seconds; 0 takes all"""


@dataclass(frozen=True)
class Status:
    """When a peer counts as located (METHOD §3)."""

    accuracy: float = 1.0
    """position 1σ above this is unobservable [m] ..."""
    accuracy_per_metre: float = 0.15
    """... or above this share of the distance, whichever is larger"""
    heading: float = 20.0
    """heading 1σ above this leaves `position` [deg]"""
    age: float = 10.0
    """a peer unheard for longer is isolated [s]"""


@dataclass(frozen=True)
class Limits:
    """Bounds the estimate keeps, at every keyframe (METHOD §5); null: no bound."""

    diameter: float | None = None
    """no two robots are farther apart [m]"""
    speed: float | None = None
    """no robot moves faster, from one keyframe to the next [m/s]"""
    disc: tuple[float, float, float] | None = None
    """[x, y, radius] in the world's frame [m]: robots stay in it; where starts are known"""
    box: tuple[float, float, float, float] | None = None
    """[x_min, y_min, x_max, y_max] in the world's frame [m]: robots stay in it; where starts are known"""


@dataclass(frozen=True)
class Configuration:
    """Everything a Localizer can be told."""

    window: float | Literal["all"] = 30.0
    """length of the window that is optimised [s], a multiple of 5 s, or all"""
    history: float = 180.0
    """measurements later than this are too late [s]"""
    period: float = 0.5
    """time between two ticks [s]"""
    candidates: int = 5
    """k: places tried for each robot when candidate graphs are formed"""
    seed: int = 0
    """of everything that is drawn by chance"""
    solver: Solver = "native"
    """what optimises the graph: the C++ core; g2o and gtsam find the same optimum, slowly, for comparison"""
    clock: Clock = "shared"
    """shared: all stamps are on one clock; estimated: each robot's clock is placed by clock readings (METHOD §1)"""
    motion: Motion = field(default_factory=Motion)
    radio: Radio = field(default_factory=Radio)
    ranging: Ranging = field(default_factory=Ranging)
    bearings: Bearings = field(default_factory=Bearings)
    status: Status = field(default_factory=Status)
    limits: Limits = field(default_factory=Limits)
    antennas: Mapping[str, tuple[float, float, float]] = field(default_factory=lambda: MappingProxyType({}))
    """robot: [x, y, z] of its antenna in its body frame [m]; `default` serves robots not named"""

    def __post_init__(self) -> None:
        checks = {
            "window must be a multiple of 5 s, at least 5": self.window == "all"
            or (self.window >= 5 and float(self.window) % 5 == 0),
            "history must be at least 10 s": self.history >= 10,
            "period must be at least 0.001 s": self.period >= 1e-3,
            "seed must be at least 0": self.seed >= 0,
            "candidates must be at least 1": self.candidates >= 1,
            "radio.path_loss_exponent must be positive": self.radio.path_loss_exponent > 0,
            "radio.sigma_db must be positive": self.radio.sigma_db > 0,
            "radio.reciprocity must be in [0, 1]": 0 <= self.radio.reciprocity <= 1,
            "ranging.sigma must be positive": self.ranging.sigma is None or self.ranging.sigma > 0,
            "ranging.sigma_per_metre must be at least 0": self.ranging.sigma_per_metre >= 0,
            "ranging.scale must be positive": self.ranging.scale > 0,
            "bearings.sigma must be positive": self.bearings.sigma is None or self.bearings.sigma > 0,
            "kernel widths must be positive": min(self.radio.width, self.ranging.width, self.bearings.width) > 0,
            "thinning must be at least 0": min(s.thinning for s in (self.radio, self.ranging, self.bearings)) >= 0,
            "limits.diameter must be positive": self.limits.diameter is None or self.limits.diameter > 0,
            "limits.speed must be positive": self.limits.speed is None or self.limits.speed > 0,
            "limits.disc must have a positive radius": self.limits.disc is None or self.limits.disc[2] > 0,
            "limits.box must have x_min < x_max, y_min < y_max": self.limits.box is None
            or (self.limits.box[0] < self.limits.box[2] and self.limits.box[1] < self.limits.box[3]),
            "motion noise must be at least 0": min(getattr(self.motion, name) for name in NOISE) >= 0,
            "motion limits must be positive": min(self.motion.maximum_speed, self.motion.maximum_turn_rate) > 0,
            "status limits must be positive": min(self.status.accuracy, self.status.heading, self.status.age) > 0,
            "status.accuracy_per_metre must be at least 0": self.status.accuracy_per_metre >= 0,
            "motion scales must be positive": min(self.motion.linear_scale, self.motion.angular_scale) > 0,
        }
        for what, holds in checks.items():
            if not holds:
                raise ConfigurationError(what)


def merge(base: Configuration, changes: Mapping[str, Any], source: str) -> Configuration:
    """``base`` with nested ``changes`` applied; ``source`` names them in errors.

    Raises ConfigurationError for unknown keys (naming the nearest) and wrong types.
    """
    return cast(Configuration, _merge(base, changes, source, ""))


def load(path: str | Path) -> Mapping[str, Any]:
    """The mapping in a YAML file. Raises ConfigurationError with file and line."""
    try:
        data, _ = plain_yaml(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: not YAML: not UTF-8 text") from error
    except PlainYamlError as error:
        raise ConfigurationError(f"{path}:{error.line}: {error}") from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigurationError(f"{path}: must be a mapping of settings, got {type(data).__name__}")
    return data


def as_dict(value: Any) -> Any:
    """Plain dicts, lists and scalars of a configuration, for YAML and JSON."""
    if dataclasses.is_dataclass(value):
        return {f.name: as_dict(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: as_dict(item) for key, item in value.items()}
    return list(value) if isinstance(value, tuple) else value


def nearest(word: str, known: Iterable[str]) -> str:
    """A hint naming the known word nearest to ``word``, empty if none is near."""
    match = difflib.get_close_matches(word[:LONGEST_WORD], list(known), n=1)
    return f"; did you mean `{match[0]}`?" if match else ""


def _merge(base: Any, changes: Mapping[str, Any], source: str, prefix: str) -> Any:
    hints = get_type_hints(type(base))
    values: dict[str, Any] = {}
    for key, value in changes.items():
        name = f"{prefix}{key}"
        if key not in hints:
            raise ConfigurationError(f"{source}: unknown setting `{brief(name)}`{nearest(str(key), hints)}")
        current = getattr(base, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigurationError(f"{source}: `{name}` must be a mapping, got {brief(repr(value))}")
            values[key] = _merge(current, value, source, f"{name}.")
        else:
            values[key] = _convert(value, hints[key], source, name)
    try:
        return dataclasses.replace(base, **values)
    except ConfigurationError as error:
        raise ConfigurationError(f"{source}: {error}") from error


def _convert(value: Any, hint: Any, source: str, name: str) -> Any:
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        for option in get_args(hint):
            try:
                return _convert(value, option, source, name)
            except ConfigurationError:
                continue
    elif origin is Literal:
        if value in get_args(hint):
            return value
    elif origin is tuple:
        if isinstance(value, list | tuple) and len(value) == len(get_args(hint)):
            return tuple(_convert(v, h, source, name) for v, h in zip(value, get_args(hint), strict=True))
    elif hint is type(None):
        if value is None:
            return None
    elif hint is float:
        if (
            isinstance(value, int | float)
            and not isinstance(value, bool)
            and value == value
            and abs(value) != float("inf")
        ):
            return float(value)
    elif hint is bool:
        if isinstance(value, bool):
            return value
    elif hint is int:
        if isinstance(value, int) and not isinstance(value, bool):
            return value
    elif isinstance(value, Mapping) and name == "antennas":
        return MappingProxyType({str(k): _antenna(v, source, f"{name}.{k}") for k, v in value.items()})
    raise ConfigurationError(f"{source}: `{name}` must be {_describe(hint)}, got {brief(repr(value))}")


def _antenna(value: Any, source: str, name: str) -> tuple[float, float, float]:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ConfigurationError(f"{source}: `{name}` must be [x, y, z] in metres, got {brief(repr(value))}")
    x, y, z = (cast(float, _convert(v, float, source, name)) for v in value)
    return x, y, z


def _describe(hint: Any) -> str:
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return " or ".join(_describe(option) for option in get_args(hint))
    if origin is Literal:
        return " or ".join(str(option) for option in get_args(hint))
    if origin is tuple:
        return f"a list of {len(get_args(hint))} numbers"
    return {float: "a number", bool: "true or false", int: "a whole number", type(None): "null"}.get(hint, "a mapping")
