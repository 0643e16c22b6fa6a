"""TOML files -> frozen dataclasses, with units and bounds beside each option."""

from arm_companion.config.load import load
from arm_companion.config.schema import Config

__all__ = ["Config", "load"]
