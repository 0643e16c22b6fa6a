"""Checks of the configuration beyond single values: what `run` would refuse, and what it takes but should not."""

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from arm_companion.app import open_configured
from arm_companion.config.schema import Config
from arm_companion.doctor.check import Check, Outcome, fail, ok, warn
from arm_companion.doctor.machine_checks import no_config
from arm_companion.doctor.subject import Subject
from arm_companion.drivers.field_page import check_token
from arm_companion.drivers.mqtt_publisher import check_files
from arm_companion.drivers.signing_keys import read_key
from arm_companion.errors import ConfigError
from arm_companion.record import check_installed


def configuration(subject: Subject) -> Iterator[Outcome]:
    """Whether the daemon would start with it."""
    config = subject.config
    if config is None:
        yield fail(subject.config_error or "there is none", "mend the file; `arm-companion config check` looks again")
        return
    try:
        open_configured(config)
        config.check_servos()
    except ConfigError as error:
        yield fail(str(error), "mend it in the file")
    if not any(link.role == "autopilot" for link in config.links.values()):
        yield fail("no link has the role autopilot", 'add one: [links.autopilot] with url and role = "autopilot"')
    if config.arm.segments:
        yield fail("an arm of several segments cannot be flown yet", "remove [[arm.segments]]")
    yield from _extras(config)
    for file in unusable_files(config):
        yield fail(file, "mend the file that it names")
    yield ok(f"{config.vehicle.autopilot}, {len(config.links)} links, {len(config.bus_servos.ids)} servos")


def access(subject: Subject) -> Outcome:
    """Who may command the arm."""
    config = subject.config
    if config is None:
        return no_config(subject)
    # ground stations come through the autopilot too; a peer may command only when it is named
    unsigned = [
        name
        for name, link in config.links.items()
        if link.role != "peer" and (not link.signing_key or link.unsigned == "accept")
    ]
    if unsigned and not config.vehicle.commanders:
        return warn(
            f"whoever reaches link {', '.join(unsigned)} may command the arm",
            "name the ground station in vehicle.commanders, or give the link a signing_key that unsigned frames do "
            "not get around",
        )
    who = ", ".join(map(str, config.vehicle.commanders)) or "whoever signs"
    return ok(f"commands are taken from: {who}")


def _extras(config: Config) -> Iterator[Outcome]:
    try:
        check_installed(config)
    except ConfigError as error:
        yield fail(str(error), "install it, or remove [record]")
    if config.mqtt.host and importlib.util.find_spec("aiomqtt") is None:
        yield warn("mqtt: nothing would be published, aiomqtt is missing", "pip install 'arm-companion[mqtt]'")


def unusable_files(config: Config) -> Iterator[str]:
    """Files of keys, passwords and certificates without which `run` refuses to start, and why."""
    for name, link in config.links.items():
        if not link.signing_key:
            continue
        try:
            read_key(Path(link.signing_key))
        except ConfigError as error:
            yield f"link {name}: {error}"
    try:
        check_files(config.mqtt)
        check_token(config.page.token_file)
    except ConfigError as error:
        yield str(error)


CHECKS: Final = (
    Check("configuration", "the daemon refuses to start on one that it cannot use, with exit code 78", configuration),
    Check("access", "whoever may command the arm moves the vehicle", access),
)
