"""The native core beside g2o in C++, g2o from Python and GTSAM: :func:`compare_solvers`."""

from dgorl.evaluation.solvers.comparison import PEERS, compare_solvers
from dgorl.evaluation.solvers.table import AGREEMENT, SolverRow, SolverSummary, SolverTable

__all__ = ["AGREEMENT", "PEERS", "SolverRow", "SolverSummary", "SolverTable", "compare_solvers"]
