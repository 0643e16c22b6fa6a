"""The taxonomy of everything that can go wrong, and what each kind means for the running system."""


class ArmError(Exception):
    """Base of every error that this package raises on purpose."""


class ConfigError(ArmError):
    """The configuration is unusable: the daemon exits with code 78 and is not restarted."""

    exit_code = 78


class LinkError(ArmError):
    """A link could not be opened or was lost: its owner reconnects with capped, jittered delays."""


class ProtocolError(ArmError):
    """Bytes that do not follow the protocol: counted and dropped when remote, a bug when local."""


class RecordError(ArmError):
    """A file is no record, or not one that this version reads."""


class DeviceFault(ArmError):
    """A servo reports a hardware fault or does not answer: a row of the failure table decides.

    Attributes:
        servo: id on the bus.
        bits: hardware-error bits of the control table (address 70), 0 when it is only silent.
    """

    def __init__(self, servo: int, bits: int, detail: str = "") -> None:
        self.servo = servo
        self.bits = bits
        error = f"hardware error 0x{bits:02x}" if bits or not detail else ""
        super().__init__(f"servo {servo}: {': '.join(filter(None, (error, detail)))}")


class ModelError(ArmError):
    """The mechanics gave no usable answer; a number is never returned in its place."""


class NoSolution(ModelError):
    """The solver found no equilibrium.

    Attributes:
        residual: norm of the unbalanced generalised force, relative to the problem's own scale.
    """

    def __init__(self, residual: float, detail: str = "") -> None:
        self.residual = residual
        super().__init__(f"no equilibrium found (residual {residual:.3g}){': ' + detail if detail else ''}")


class LimitViolated(ModelError):
    """A value lies outside the range in which the model or the hardware may be used."""

    def __init__(self, name: str, value: float, lower: float, upper: float) -> None:
        self.name = name
        self.value = value
        self.lower = lower
        self.upper = upper
        super().__init__(f"{name} = {value:.6g} is outside [{lower:.6g}, {upper:.6g}]")


class CommandRejected(ArmError):
    """A command is refused; the reason goes back with the acknowledgement and as a STATUSTEXT."""

    def __init__(self, reason: str) -> None:
        self.reason = reason
        super().__init__(reason)


def in_words(error: BaseException) -> str:
    """Kind and text of an exception, such as one that nobody foresaw."""
    return f"{type(error).__name__}: {error}"


def place(error: BaseException) -> str:
    """Where in this package it came from, "MODULE:LINE in FUNCTION"; empty: not from here."""
    where, trace = "", error.__traceback__
    while trace is not None:  # NumPy's own lines would say little
        module = trace.tb_frame.f_globals.get("__name__", "")
        if module.partition(".")[0] == "arm_companion":
            where = f"{module}:{trace.tb_lineno} in {trace.tb_frame.f_code.co_name}"
        trace = trace.tb_next
    return where
