"""What suits research and cannot be flown."""

from arm_companion.config.schema import Config
from arm_companion.errors import ConfigError


def check_flyable(config: Config) -> None:
    """Refuse what suits research and cannot be flown.

    Raises:
        ConfigError: no link to the autopilot, an arm of several segments, or servos that do not suit the tendons.
    """
    if not any(link.role == "autopilot" for link in config.links.values()):
        raise ConfigError("links: none has the role autopilot")
    if config.arm.segments:
        raise ConfigError("arm.segments: the perch is flown by an arm of one segment")
    config.check_servos()
