"""The door to ``edges.cpp``: a problem's arrays in, poses, covariance and CPU times out."""

from __future__ import annotations

import ctypes
from ctypes import c_double, c_int32, c_int64, c_void_p

import numpy as np

from dgorl.evaluation.solvers.compiled import g2o_library
from dgorl.evaluation.solvers.run import Run, bare
from dgorl.optimization.problem import Indices, Problem

_FAILED = {-1: "takes no step", -2: "finds no marginals"}


class _Graph(ctypes.Structure):
    """``Graph`` of edges.cpp, field by field."""

    _fields_ = (
        *(("poses", c_int64), ("ids", c_void_p), ("initial", c_void_p), ("fixed", c_void_p)),
        *(("relatives", c_int64), ("from", c_void_p), ("to", c_void_p), ("delta", c_void_p), ("information", c_void_p)),
        *(("readings", c_int64), ("i", c_void_p), ("j", c_void_p), ("value", c_void_p), ("sigma", c_void_p)),
        *(("is_rssi", c_int32), ("at_1m", c_double), ("exponent", c_double)),
    )


def optimize(problem: Problem, newest: Indices, iterations: int) -> Run:
    """g2o's Levenberg–Marquardt in C++, blocks of fixed size, then the joint marginals of the newest poses.

    Raises MissingExtraError where it cannot be compiled, RuntimeError when g2o fails.
    """
    library = g2o_library()
    graph = bare(problem)
    initial, fixed = np.ascontiguousarray(problem.initial), np.ascontiguousarray(problem.fixed, dtype=np.uint8)
    ids = np.argsort(np.argsort(problem.slots, kind="stable"), kind="stable")  # along time, as the core eliminates
    size, chosen = 3 * len(newest), np.ascontiguousarray(newest, dtype=np.int64)
    poses, covariance, seconds = np.empty_like(initial), np.empty((size, size)), np.empty(3)
    described = _Graph(
        *(len(initial), ids.ctypes.data, initial.ctypes.data, fixed.ctypes.data),
        *(len(graph.start), *(a.ctypes.data for a in (graph.start, graph.end, graph.delta, graph.information))),
        *(len(graph.i), *(a.ctypes.data for a in (graph.i, graph.j, graph.value, graph.sigma))),
        *(graph.kind == "rssi", *problem.radio),
    )
    taken = library.dgorl_g2o(
        ctypes.byref(described), c_int64(iterations), c_int64(len(chosen)), c_void_p(chosen.ctypes.data),
        *(c_void_p(array.ctypes.data) for array in (poses, covariance, seconds)),
    )  # fmt: skip
    if taken < 0:
        raise RuntimeError(f"g2o {_FAILED[taken]}")
    build, optimise, marginals = (1e3 * seconds).tolist()
    return Run(poses, build, optimise, marginals, taken, covariance)
