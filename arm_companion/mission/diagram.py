"""Writes the diagram of perches and grasp: `python -m arm_companion.mission.diagram > docs/perch_states.md`."""

from arm_companion.mission.machine import mermaid
from arm_companion.mission.perch import TABLE
from arm_companion.mission.state import Phase

HEADER = """# States of perches and grasp

Made from the transition table in `perch.py`, `hang.py`, `grasp.py`, `reach_table.py` and `calibrating.py` of
`arm_companion/mission/`; a test fails when the two differ. Aborts are marked ✗. Rows are tried from the table's top, so
aborts win over progress.

"""


def document() -> str:
    """The whole page."""
    return f"{HEADER}```mermaid\n{mermaid(TABLE, Phase)}```\n"


if __name__ == "__main__":
    print(document(), end="")
