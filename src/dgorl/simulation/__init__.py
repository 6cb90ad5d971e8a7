"""Simulated teams: ``simulate(Scenario(...))`` gives a log with ground truth."""

from dgorl.simulation.recording import simulate
from dgorl.simulation.scenario import Scenario, Teleport

__all__ = ["Scenario", "Teleport", "simulate"]
