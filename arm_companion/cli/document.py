"""docs/cli.md, from the parsers.

python -m arm_companion.cli.document > docs/cli.md
"""

import argparse
import os
import sys
from collections.abc import Iterator

from arm_companion.__main__ import command_line

_HEAD = """\
# All commands

Generated from the parsers by `python -m arm_companion.cli.document`; a test compares. Exit codes, where a command does
not say otherwise: 0 done, 1 failed, 2 wrong options, 78 wrong configuration.
"""
_COLUMNS = 100


def document() -> str:
    """The whole page, in Markdown."""
    os.environ["COLUMNS"] = str(_COLUMNS)  # what argparse wraps by
    return "\n".join([_HEAD, *map(_part, parsers(command_line()))])


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """All parsers below one, each before its own."""
    for action in parser._actions:  # noqa: SLF001 - argparse has no other way to its subparsers
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            for sub in action.choices.values():
                yield sub
                yield from parsers(sub)


def _part(parser: argparse.ArgumentParser) -> str:
    level = "##" if parser.prog.count(" ") == 1 else "###"
    return f"{level} `{parser.prog}`\n\n```text\n{parser.format_help().strip()}\n```\n"


if __name__ == "__main__":
    sys.stdout.write(document())
