"""Every argument of the core is checked, and the error names it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dgorl import _core

Array = np.ndarray
EYE = np.broadcast_to(np.eye(3), (2, 3, 3))
PAIR = {"i": np.array([0, 1]), "j": np.array([1, 2])}
POINTS = {"at_i": np.zeros((2, 2)), "at_j": np.zeros((2, 2)), "height": np.zeros(2)}
KERNEL = {"kernel": _core.HUBER, "width": 2.0}

GOOD: dict[str, dict[str, Any]] = {
    "relative_poses": {
        **PAIR,
        "at_i": np.zeros((2, 3)),
        "at_j": np.zeros((2, 3)),
        "delta": np.zeros((2, 3)),
        "information": EYE,
        **KERNEL,
    },
    "odometry": {**PAIR, "delta": np.zeros((2, 3)), "information": EYE},
    "ranges": {**PAIR, **POINTS, "range": np.ones(2), "sigma": np.ones(2), **KERNEL},
    "rssi": {
        **PAIR,
        **POINTS,
        "rssi": np.full(2, -60.0),
        "rssi_at_1m": np.full(2, -40.0),
        "exponent": np.full(2, 3.0),
        "sigma": np.full(2, 2.0),
        **KERNEL,
    },
    "bearings": {
        "observer": PAIR["i"],
        "target": PAIR["j"],
        "at_observer": np.zeros((2, 3)),
        "at_target": np.zeros((2, 2)),
        "bearing": np.zeros(2),
        "sigma": np.ones(2),
        **KERNEL,
    },
    "prior": {
        "reference": 0,
        "members": np.array([1, 2]),
        "relative": np.zeros((2, 3)),
        "information": np.eye(6),
        "gradient": np.zeros(6),
    },
}
FIRST_INDEX = {"bearings": "observer", "prior": "members"}


def graph() -> _core.Graph:
    """Poses 0 and 1 in the first slot, 2 in the second, 3 in the third; 4 is fixed."""
    return _core.Graph([0, 0, 4, 9, -1], [False, False, False, False, True])


def add(family: str, **changes: Any) -> _core.Graph:
    g = graph()
    getattr(g, f"add_{family}")(**{**GOOD[family], **changes})
    return g


def spoiled(value: Any, what: Any) -> Array:
    out = np.array(value, dtype=float)
    out.flat[-1] = what
    return out


def cases() -> list[Any]:
    out = []

    def case(family: str, argument: str, value: Any, message: str) -> None:
        out.append(pytest.param(family, argument, value, message, id=f"{family}.{argument}: {message}"))

    for family, arguments in GOOD.items():
        for argument, value in arguments.items():
            name = rf"{family}\.{argument}"
            if isinstance(value, np.ndarray):
                case(family, argument, value[..., None], f"{name}: must have shape")
                case(family, argument, "what", f"{name}: must be")
                case(family, argument, [[1.0], [2.0, 3.0]], f"{name}: must be")
                if argument != FIRST_INDEX.get(family, "i"):
                    case(family, argument, value[:1], f"{name}: must have")
            if isinstance(value, np.ndarray) and value.dtype == np.int64:
                case(family, argument, np.array([0.0, 1.0]), f"{name}: must be convertible to int64")
                case(
                    family,
                    argument,
                    np.array([value[0], 5]),
                    rf"{name}: must be a pose index below 5 \(row 1\)",
                )
                case(
                    family,
                    argument,
                    np.array([value[0], -1]),
                    rf"{name}: must be a pose index below 5 \(row 1\)",
                )
            elif isinstance(value, np.ndarray):
                case(family, argument, spoiled(value, np.nan), rf"{name}: must be finite \(row \d\)")
                case(family, argument, spoiled(value, np.inf), rf"{name}: must be finite \(row \d\)")
            if argument in ("sigma", "exponent"):
                case(family, argument, spoiled(value, 0.0), rf"{name}: must be positive \(row 1\)")
                case(family, argument, spoiled(value, -1.0), rf"{name}: must be positive \(row 1\)")
            if argument == "information":
                skew = np.array(value)
                skew[..., 0, 1] = 0.1
                case(family, argument, skew, f"{name}: must be symmetric")
            if argument == "kernel":
                case(family, argument, 5, f"{name}: must be one of")
                case(family, argument, -1, f"{name}: must be one of")
            if argument == "width":
                for width in (0.0, -1.0, np.nan, np.inf):
                    case(family, argument, width, f"{name}: must be positive")
        if family != "prior":
            i, j = ("observer", "target") if family == "bearings" else ("i", "j")
            case(family, j, np.array([1, 1]), rf"{family}\.{j}: must differ from {i} \(row 1\)")
            case(family, j, np.array([3, 2]), rf"{family}\.{j}: must be in the slot of {i} or .*row 0")
    for family in ("relative_poses", "odometry"):
        indefinite = np.array([np.eye(3), np.diag([1.0, -1.0, 1.0])])
        case(family, "information", indefinite, rf"{family}\.information: must be positive semi-def.*row 1")
        hollow = np.array([np.eye(3), [[0, 1, 0], [1, 0, 0], [0, 0, 1]]])
        case(family, "information", hollow, rf"{family}\.information: must be positive semi-def.*row 1")
    case("relative_poses", "kernel", _core.HUBER_NEGATIVE, r"relative_poses\.kernel: one-sided")
    case("prior", "members", np.array([1, 0]), r"prior\.members: must differ from one another \(row 1\)")
    case("prior", "members", np.array([1, 3]), r"prior\.members: must be in one slot or two")
    case("prior", "members", np.array([], dtype=np.int64), r"prior\.")
    case("prior", "reference", 5, r"prior\.reference: must be a pose index below 5")
    case("prior", "reference", -2, r"prior\.reference: must be a pose index below 5")
    return out


@pytest.mark.parametrize(("family", "argument", "value", "message"), cases())
def test_a_wrong_argument_is_named(family: str, argument: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        add(family, **{argument: value})


@pytest.mark.parametrize("family", GOOD)
def test_right_arguments_are_taken(family: str) -> None:
    assert len(add(family).residuals(np.zeros((5, 3)))) == 1
    if family == "prior":
        add(family, reference=4)
        add(family, reference=-1)
        return
    i, j = ("observer", "target") if family == "bearings" else ("i", "j")
    add(family, **{i: np.array([4, 3]), j: np.array([0, 4])})  # fixed poses reach every slot
    nothing = {k: v[:0] for k, v in GOOD[family].items() if isinstance(v, np.ndarray)}
    [(_, residuals)] = add(family, **nothing).residuals(np.zeros((5, 3)))
    assert len(residuals) == 0


def test_other_dtypes_strides_and_lists_are_converted() -> None:
    poses = np.random.default_rng(0).normal(size=(5, 3))
    plain = add("ranges").cost(poses)
    wide = np.zeros((4, 4))[::2, ::2]
    assert add("ranges", i=[0, 1], j=np.array([1, 2], dtype=np.int32), at_i=wide, sigma=[1, 1]).cost(poses) == plain
    assert add("ranges").cost(np.asfortranarray(poses)) == plain
    assert add("ranges").cost(poses.tolist()) == plain


def test_a_refused_call_adds_nothing() -> None:
    g = graph()
    with pytest.raises(ValueError, match="semi-definite"):
        g.add_odometry([0, 1], [1, 2], np.zeros((2, 3)), np.array([np.eye(3), -np.eye(3)]))
    assert g.residuals(np.zeros((5, 3))) == []


POSES = np.zeros((5, 3))
CALLS: dict[str, tuple[Callable[[_core.Graph, Array], Any], str]] = {
    "optimize": (lambda g, x: g.optimize(x[None]), "initial"),
    "solve": (lambda g, x: g.solve(x, [0]), "initial"),
    "cost": (lambda g, x: g.cost(x), "poses"),
    "residuals": (lambda g, x: g.residuals(x), "poses"),
    "covariance": (lambda g, x: g.covariance(x, [0]), "poses"),
    "marginalize": (lambda g, x: g.marginalize(x, 4), "poses"),
    "gauss_newton_step": (lambda g, x: g.gauss_newton_step(x), "poses"),
    "hessian": (lambda g, x: g.hessian(x), "poses"),
}


@pytest.mark.parametrize("call", CALLS)
def test_poses_are_checked(call: str) -> None:
    run, name = CALLS[call]
    for poses in (POSES[:4], np.zeros((5, 2)), POSES[0], np.zeros((5, 3), dtype=object)):
        with pytest.raises(ValueError, match=f"^{name}: must"):
            run(add("odometry"), poses)
    with pytest.raises(ValueError, match=rf"^{name}: must be finite \(row 4\)"):
        run(add("odometry"), spoiled(POSES, np.nan))


@pytest.mark.parametrize("call", ["solve", "covariance"])
def test_selection_is_checked(call: str) -> None:
    for select, message in (
        ([5], "pose index below 5"),
        ([-1], "pose index"),
        ([0.5], "int64"),
        (0, "shape"),
    ):
        with pytest.raises(ValueError, match=f"^select: must.*{message}"):
            getattr(add("odometry"), call)(POSES, select)


@pytest.mark.parametrize("call", ["optimize", "solve"])
@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("max_iterations", -1),
        *(("step_tolerance", v) for v in (0.0, -1.0, np.nan, np.inf)),
        *(("initial_damping", v) for v in (-1e-3, np.nan, np.inf)),
    ],
)
def test_options_are_checked(call: str, option: str, value: float) -> None:
    arguments = (POSES[None],) if call == "optimize" else (POSES, [0])
    with pytest.raises(ValueError, match=f"^{option}: must"):
        getattr(add("odometry"), call)(*arguments, **{option: value})


@pytest.mark.parametrize(
    ("slots", "fixed", "message"),
    [
        ([0, -1], [False, False], r"slots: must not be negative.*row 1"),
        ([0, -2], [False, True], r"slots: must not be negative.*row 1"),
        ([0.5, 1.0], [False, True], "slots: must be convertible to int64"),
        ([[0, 1]], [False, True], "slots: must have shape"),
        ([0, 1], [0, 1], "fixed: must be convertible to bool"),
        ([0, 1], [False], "fixed: must have one entry per slot"),
    ],
)
def test_slots_and_fixed_are_checked(slots: Any, fixed: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        _core.Graph(slots, fixed)
