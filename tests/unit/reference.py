"""A window graph in plain NumPy, written from METHOD §1 and §2 to be read, not to be fast.

Every factor is a function from the poses (N, 3) to (residual, information, kernel, width); Jacobians are
differences; the Hessian is dense. The core is tested against it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dgorl import _core, se2

NONE, HUBER, CAUCHY, HUBER_NEGATIVE, CAUCHY_NEGATIVE = range(5)
Array = np.ndarray
STEP = 5e-4
STENCIL = ((1, 2 / 3), (-1, -2 / 3), (2, -1 / 12), (-2, 1 / 12))
"""Fourth-order central difference: plain ones leave 1e-8 in the optimum."""


def retract(poses: Array, xi: Array) -> Array:
    """X · Exp(ξ) for each row."""
    return se2.compose(poses, se2.exp(xi))


def rows(poses: Array | list[int]) -> Array:
    """Rows of the variables of some poses."""
    return np.asarray(3 * np.asarray(poses, dtype=int)[:, None] + np.arange(3)).ravel()


def relative_pose(i: int, j: int, at_i: Array, at_j: Array, delta: Array) -> Callable[[Array], Array]:
    """vec(δ⁻¹ (X_i B_i)⁻¹ (X_j B_j))."""

    def residual(x: Array) -> Array:
        return se2.between(delta, se2.between(se2.compose(x[i], at_i), se2.compose(x[j], at_j)))

    return residual


def slant(x: Array, i: int, j: int, at_i: Array, at_j: Array, height: float) -> float:
    """Distance between two antennas whose heights differ."""
    ground = se2.transform(x[i], at_i) - se2.transform(x[j], at_j)
    return float(np.hypot(np.hypot(*ground), height))


def metric_range(i: int, j: int, at_i: Array, at_j: Array, height: float, measured: float) -> Callable[[Array], Array]:
    return lambda x: np.array([slant(x, i, j, at_i, at_j, height) - measured])


def rssi(
    i: int, j: int, at_i: Array, at_j: Array, height: float, measured: float, at_1m: float, exponent: float
) -> Callable[[Array], Array]:
    def residual(x: Array) -> Array:
        d = max(slant(x, i, j, at_i, at_j, height), 0.1)
        return np.array([measured - (at_1m - 10 * exponent * np.log10(d))])

    return residual


def bearing(
    observer: int, target: int, at_observer: Array, at_target: Array, measured: float
) -> Callable[[Array], Array]:
    def residual(x: Array) -> Array:
        sensor = se2.compose(x[observer], at_observer)
        px, py = se2.transform(se2.inverse(sensor), se2.transform(x[target], at_target))
        return se2.wrap([np.arctan2(py, px) - measured])

    return residual


def displacement(reference: int, members: Array, relative: Array) -> Callable[[Array], Array]:
    """δ_j = vec(Z_j⁻¹ X_ref⁻¹ X_j), stacked."""

    def residual(x: Array) -> Array:
        origin = x[reference] if reference >= 0 else np.zeros(3)
        return se2.between(relative, se2.between(origin, x[members])).ravel()

    return residual


def rho(s: float, kernel: int, width: float) -> tuple[float, float]:
    """ρ(s) and ρ'(s) of a squared Mahalanobis norm."""
    if kernel in (HUBER, HUBER_NEGATIVE):
        if s <= width**2:
            return s, 1.0
        return 2 * width * np.sqrt(s) - width**2, width / np.sqrt(s)
    if kernel in (CAUCHY, CAUCHY_NEGATIVE):
        return width**2 * np.log(1 + s / width**2), 1 / (1 + s / width**2)
    return s, 1.0


@dataclass
class Factor:
    poses: list[int]
    residual: Callable[[Array], Array]
    information: Array
    kernel: int = NONE
    width: float = 1.0
    gradient: Array | None = None  # linear term, of a prior

    def active(self, e: Array) -> int:
        """One-sided kernels are robust where e < 0 only."""
        one_sided = self.kernel in (HUBER_NEGATIVE, CAUCHY_NEGATIVE)
        return NONE if one_sided and e[0] >= 0 else self.kernel

    def cost(self, x: Array) -> float:
        e = self.residual(x)
        linear = 0.0 if self.gradient is None else float(self.gradient @ e)
        return 0.5 * rho(float(e @ self.information @ e), self.active(e), self.width)[0] + linear

    def moved(self, x: Array, pose: int, xi: Array) -> Array:
        """The residual with one pose moved by ξ."""
        moved = x.copy()
        moved[pose] = retract(x[pose], xi)
        return self.residual(moved)

    def normal_equations(self, x: Array) -> tuple[Array, Array]:
        """Jᵀ ρ'Ω J and Jᵀ(ρ'Ω e + g) over the factor's own poses, in their order."""
        e = self.residual(x)
        columns = [
            sum(w * self.moved(x, pose, k * STEP * axis) for k, w in STENCIL) / STEP
            for pose in self.poses
            for axis in np.eye(3)
        ]
        jacobian = np.transpose(columns)
        weight = rho(float(e @ self.information @ e), self.active(e), self.width)[1]
        linear = np.zeros(e.size) if self.gradient is None else self.gradient
        return (
            weight * jacobian.T @ self.information @ jacobian,
            jacobian.T @ (weight * self.information @ e + linear),
        )


@dataclass
class ReferenceGraph:
    fixed: Array
    factors: list[Factor] = field(default_factory=list)

    @property
    def free(self) -> Array:
        """Rows of the free poses' variables."""
        return np.flatnonzero(np.repeat(~self.fixed, 3))

    def cost(self, x: Array) -> float:
        return sum(f.cost(x) for f in self.factors)

    def normal_equations(self, x: Array) -> tuple[Array, Array]:
        """H and g over the free poses by index."""
        h, g = self.all_normal_equations(x, self.factors)
        return h[np.ix_(self.free, self.free)], g[self.free]

    @staticmethod
    def all_normal_equations(x: Array, factors: list[Factor]) -> tuple[Array, Array]:
        """H (3N, 3N) and g (3N,) of some factors over all poses."""
        h, g = np.zeros((x.size, x.size)), np.zeros(x.size)
        for f in factors:
            dh, dg = f.normal_equations(x)
            r = rows(f.poses)
            h[np.ix_(r, r)] += dh
            g[r] += dg
        return h, g

    def step(self, x: Array) -> Array:
        """The Gauss–Newton step (N, 3)."""
        h, g = self.normal_equations(x)
        xi = np.zeros(x.size)
        xi[self.free] = -np.linalg.solve(h, g)
        return xi.reshape(-1, 3)

    def optimize(self, x: Array, iterations: int = 60) -> Array:
        """Damped Gauss–Newton: halve the step until the cost falls."""
        for _ in range(iterations):
            xi, length = self.step(x), 1.0
            # Below 1e-4 the cost cannot tell any more whether a step is good.
            while np.abs(length * xi).max() > 1e-4 and self.cost(retract(x, length * xi)) > self.cost(x):
                length /= 2
            x = retract(x, length * xi)
            if np.abs(xi).max() < 1e-10:
                break
        return x

    def covariance(self, x: Array, select: Array) -> Array:
        h, _ = self.normal_equations(x)
        full = np.zeros((x.size, x.size))
        full[np.ix_(self.free, self.free)] = np.linalg.inv(h)
        return full[np.ix_(rows(select), rows(select))]


# ---- the same graph in the core and in the reference ----


@dataclass
class Twin:
    """A core graph and its reference, filled together."""

    core: _core.Graph
    reference: ReferenceGraph
    poses: Array
    slots: Array

    @classmethod
    def of(cls, poses: Array, slots: Array, fixed: Array) -> Twin:
        return cls(_core.Graph(slots, fixed), ReferenceGraph(np.asarray(fixed)), poses, np.asarray(slots))

    def add_relative_poses(self, i, j, at_i, at_j, delta, information, kernel=NONE, width=1.0) -> None:
        self.core.add_relative_poses(i, j, at_i, at_j, delta, information, kernel, width)
        for k in range(len(i)):
            e = relative_pose(i[k], j[k], at_i[k], at_j[k], delta[k])
            self.reference.factors.append(Factor([i[k], j[k]], e, information[k], kernel, width))

    def add_odometry(self, i, j, delta, information) -> None:
        self.core.add_odometry(i, j, delta, information)
        for k in range(len(i)):
            e = relative_pose(i[k], j[k], np.zeros(3), np.zeros(3), delta[k])
            self.reference.factors.append(Factor([i[k], j[k]], e, information[k]))

    def add_ranges(self, i, j, at_i, at_j, height, measured, sigma, kernel=NONE, width=1.0) -> None:
        self.core.add_ranges(i, j, at_i, at_j, height, measured, sigma, kernel, width)
        for k in range(len(i)):
            e = metric_range(i[k], j[k], at_i[k], at_j[k], height[k], measured[k])
            self._scalar([i[k], j[k]], e, sigma[k], kernel, width)

    def add_rssi(self, i, j, at_i, at_j, height, measured, at_1m, exponent, sigma, kernel=NONE, width=1.0) -> None:
        self.core.add_rssi(i, j, at_i, at_j, height, measured, at_1m, exponent, sigma, kernel, width)
        for k in range(len(i)):
            e = rssi(i[k], j[k], at_i[k], at_j[k], height[k], measured[k], at_1m[k], exponent[k])
            self._scalar([i[k], j[k]], e, sigma[k], kernel, width)

    def add_bearings(self, i, j, at_i, at_j, measured, sigma, kernel=NONE, width=1.0) -> None:
        self.core.add_bearings(i, j, at_i, at_j, measured, sigma, kernel, width)
        for k in range(len(i)):
            e = bearing(i[k], j[k], at_i[k], at_j[k], measured[k])
            self._scalar([i[k], j[k]], e, sigma[k], kernel, width)

    def add_prior(self, reference, members, relative, information, gradient) -> None:
        self.core.add_prior(reference, members, relative, information, gradient)
        e = displacement(reference, members, relative)
        poses = [k for k in (reference, *members) if k >= 0]
        self.reference.factors.append(Factor(poses, e, information, gradient=gradient))

    def _scalar(self, poses: list[int], residual: Callable, sigma: float, kernel: int, width: float) -> None:
        self.reference.factors.append(Factor(poses, residual, np.array([[sigma**-2]]), kernel, width))


def random_information(rng: np.random.Generator, count: int, size: int = 3) -> Array:
    root = rng.normal(size=(count, size, size)) + 3 * np.eye(size)
    return root @ root.transpose(0, 2, 1)


def team(
    rng: np.random.Generator,
    *,
    robots: int = 3,
    steps: int = 5,
    gauge: str = "pose",
    kernels: bool = True,
    permute: bool = True,
    noise: float = 1.0,
) -> Twin:
    """A window of a small team with every kind of factor; ``poses`` is the truth, disturbed a little.

    gauge: ``pose`` fixes the first robot's first keyframe, ``world`` adds a fixed pose with relative poses to
    it, ``prior`` an absolute prior, ``none`` leaves the gauge free. One robot misses the middle slot.
    """
    index = {}
    slots, truth = [], []
    start = np.column_stack([rng.uniform(-6, 6, (robots, 2)), rng.uniform(-3, 3, robots)])
    for r in range(robots):
        x = start[r]
        for t in range(steps):
            if not (r == robots - 1 and t == steps // 2 and steps > 3):
                index[r, t] = len(truth)
                truth.append(x)
                slots.append(7 + 2 * t)
            x = se2.compose(x, [0.6, 0.0, rng.uniform(-0.5, 0.5)])
    world = len(truth) if gauge == "world" else None
    if world is not None:
        truth.append(np.array([1.0, -2.0, 0.4]))
        slots.append(-1)
    order = rng.permutation(len(truth)) if permute else np.arange(len(truth))
    place = np.argsort(order)
    index = {key: int(place[k]) for key, k in index.items()}
    poses, slot = np.array(truth)[order], np.array(slots)[order]
    fixed = np.zeros(len(poses), dtype=bool)
    if gauge == "pose":
        fixed[index[0, 0]] = True
    if world is not None:
        world = int(place[world])
        fixed[world] = True
    twin = Twin.of(poses, slot, fixed)

    def pairs(count: int) -> tuple[Array, Array]:
        """Poses of different robots, in one slot or in adjacent ones."""
        keys = sorted(index)
        out = []
        while len(out) < count:
            a, b = (keys[k] for k in rng.integers(len(keys), size=2))
            if a[0] != b[0] and abs(a[1] - b[1]) <= 1 and not (fixed[index[a]] and fixed[index[b]]):
                out.append((index[a], index[b]))
        return np.array(out)[:, 0], np.array(out)[:, 1]

    def kernel(*options: int) -> tuple[int, float]:
        return (int(rng.choice(options)), float(rng.uniform(0.5, 2.0))) if kernels else (NONE, 1.0)

    odometry = [(index[key], index[key[0], key[1] + 1]) for key in sorted(index) if (key[0], key[1] + 1) in index]
    i, j = np.array(odometry).T
    sigma = np.array([0.05, 0.03, 0.04]) * noise
    delta = se2.compose(se2.between(poses[i], poses[j]), rng.normal(size=(len(i), 3)) * sigma)
    twin.add_odometry(i, j, delta, random_information(rng, len(i)) / 10 / np.outer(sigma, sigma))

    i, j = pairs(4 * robots)
    at_i, at_j = rng.normal(size=(2, len(i), 3)) * 0.2
    seen = se2.between(se2.compose(poses[i], at_i), se2.compose(poses[j], at_j))
    delta = se2.compose(seen, 0.2 * noise * rng.normal(size=(len(i), 3)))
    twin.add_relative_poses(i, j, at_i, at_j, delta, random_information(rng, len(i)), *kernel(NONE, HUBER, CAUCHY))

    every = (NONE, HUBER, CAUCHY, HUBER_NEGATIVE, CAUCHY_NEGATIVE)
    i, j = pairs(8 * robots)
    at_i, at_j = rng.normal(size=(2, len(i), 2)) * 0.2
    height, sigma = rng.normal(size=len(i)), rng.uniform(0.1, 0.3, len(i))
    d = np.array([slant(poses, *row) for row in zip(i, j, at_i, at_j, height, strict=True)])
    twin.add_ranges(i, j, at_i, at_j, height, d + noise * sigma * rng.normal(size=len(i)), sigma, *kernel(*every))

    at_1m, exponent = rng.uniform(-50, -30, len(i)), rng.uniform(2, 4, len(i))
    measured = at_1m - 10 * exponent * np.log10(d) + noise * 2 * rng.normal(size=len(i))
    twin.add_rssi(j, i, at_j, at_i, -height, measured, at_1m, exponent, np.full(len(i), 2.0), *kernel(*every))

    i, j = pairs(4 * robots)
    at_i, at_j = rng.normal(size=(len(i), 3)) * 0.2, rng.normal(size=(len(i), 2)) * 0.2
    truth_bearing = [bearing(*row, 0.0)(poses)[0] for row in zip(i, j, at_i, at_j, strict=True)]
    sigma = rng.uniform(0.05, 0.2, len(i))
    measured = truth_bearing + noise * sigma * rng.normal(size=len(i)) + 2 * np.pi
    twin.add_bearings(i, j, at_i, at_j, measured, sigma, *kernel(*every))

    first, second = (np.array([index[r, t] for r in range(robots)]) for t in (0, 1))
    members = np.concatenate([first[1:], second[:1]])
    relative = se2.compose(
        se2.between(poses[first[0]], poses[members]), 0.1 * noise * rng.normal(size=(len(members), 3))
    )
    information = random_information(rng, 1, 3 * len(members))[0]
    twin.add_prior(first[0], members, relative, information, noise * rng.normal(size=3 * len(members)))
    if gauge == "prior":
        information = random_information(rng, 1, 3)[0]
        twin.add_prior(-1, first[:1], poses[first[:1]], information, 0.1 * rng.normal(size=3))
    if world is not None:
        i = np.full(3, world)
        j = np.array([index[0, 0], index[1, 1], index[0, steps - 1]])
        delta = se2.compose(se2.between(poses[i], poses[j]), 0.1 * noise * rng.normal(size=(3, 3)))
        twin.add_relative_poses(i, j, np.zeros((3, 3)), np.zeros((3, 3)), delta, random_information(rng, 3))
    disturbed = 0.05 * noise * rng.normal(size=poses.shape)
    twin.poses = np.where(fixed[:, None], poses, retract(poses, disturbed))
    return twin
