"""Command-line parsing for commands whose arguments are mostly numbers."""

import argparse
from collections.abc import Sequence
from typing import Any, NoReturn


class NumberParser(argparse.ArgumentParser):
    """Takes every number as a number, and refuses in one line.

    argparse reads "-1" as a number but "-1e-3" as an unknown option; with a blank in front it is no option.
    """

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """See `argparse.ArgumentParser.parse_known_args`."""
        words = None if args is None else [f" {word}" if _is_negative(word) else word for word in args]
        found, unknown = super().parse_known_args(words, namespace)
        if unknown:  # else the parser above would refuse it, with its usage in front
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        """Say what is wrong in one line; exit code 2."""
        self.exit(2, f"{self.prog}: {message}\n")


def _is_negative(word: str) -> bool:
    if not word.startswith("-"):
        return False
    try:
        float(word)
    except ValueError:
        return False
    return True
