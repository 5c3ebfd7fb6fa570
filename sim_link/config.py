"""Scenario files: YAML to `Scenario`."""

from __future__ import annotations

from pathlib import Path

from companion.config.load import load_yaml
from sim_link.autopilot.scenario import Scenario

__all__ = ["Scenario", "load_scenario"]


def load_scenario(path: Path) -> Scenario:
    """The scenario of a YAML file; keys it does not give keep their canonical value.

    Raises:
        ConfigError: The file cannot be read, or a key, type or value in it is wrong.
    """
    return load_yaml(path, Scenario)
