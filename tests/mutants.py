"""Mutation testing of the mission on a sample (`make mutants`): small faults are put in, and tests must notice each.

mutmut makes the mutants, finds by one traced run which test calls which function, and runs those. All of them take too
long: a mutant that survives costs every test that comes by. So a sample is drawn, the same for the same seed, and of
the tests that call a mutated function only the cheapest count, up to a budget. What survives has been missed by those;
the rest may still notice it.
"""

import argparse
import ast
import difflib
import json
import random
import re
import subprocess
import sys
from pathlib import Path

MADE = Path("mutants")
STATS = MADE / "mutmut-stats.json"
MISSION = MADE / "arm_companion" / "mission"
_CHEAP = "arm_companion.mission.gripper.x_lifted_from__mutmut_1"
_KILLED, _SURVIVED = 1, 0
_STRINGS = re.compile(r"""f?"[^"]*"|f?'[^']*'""")


def main() -> None:
    """Draw, run, and say what survived."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", help="of arm_companion/mission; all when none is named")
    parser.add_argument("--number", type=int, default=10, help="mutants of each module")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--budget", type=float, default=20.0, help="seconds of tests for a mutant that survives")
    asked = parser.parse_args()
    _mutmut(_CHEAP)  # makes what is missing or old: mutants, and who calls what
    modules = asked.modules or sorted(path.name.removesuffix(".py.meta") for path in MISSION.glob("*.meta"))
    drawn = {module: draw(module, asked.number, asked.seed) for module in modules}
    for module, names in drawn.items():
        forget(module, names)
    known = STATS.read_text()
    try:
        STATS.write_text(json.dumps(thrifty(json.loads(known), asked.budget)))
        _mutmut(*(name for names in drawn.values() for name in names))
    finally:
        STATS.write_text(known)
    for module, names in drawn.items():
        codes = _codes(module)
        alive = [name for name in names if codes[name] == _SURVIVED]
        others = [name for name in names if codes[name] not in {_SURVIVED, _KILLED}]
        print(f"{module}: {len(names)} tried, {len(alive)} survived, {len(others)} without tests or too slow")
        for name in alive:
            print(f"  {name}\n    {'; '.join(change(module, name))}")


def draw(module: str, number: int, seed: int) -> list[str]:
    """Names of mutants, without those that only word a sentence differently or come too late."""
    early = called_at_import()
    names = [name for name in sorted(_codes(module)) if _function(name) not in early]
    every = [name for name in names if _counts(change(module, name))]
    return random.Random(f"{seed} {module}").sample(every, min(number, len(every)))


def called_at_import() -> set[str]:
    """Functions that make rows and constants: they have done so before the mutant is chosen, so it changes nothing."""
    waiting: list[ast.AST] = [ast.parse(path.read_text()) for path in Path("arm_companion/mission").glob("*.py")]
    found = set()
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            found.add(node.func.id)
        if not isinstance(node, (ast.FunctionDef, ast.Lambda)):
            waiting += ast.iter_child_nodes(node)
    return found


def forget(module: str, names: list[str]) -> None:
    """What came of these mutants before: a run that is stopped must not report it."""
    path = MISSION / f"{module}.py.meta"
    meta = json.loads(path.read_text())
    meta["exit_code_by_key"].update(dict.fromkeys(names))
    path.write_text(json.dumps(meta))


def thrifty(stats: dict, seconds: float) -> dict:
    """mutmut's knowledge of who calls what, with the cheapest tests of each function."""
    took, calls = stats["duration_by_test"], stats["tests_by_mangled_function_name"]
    for name, tests in calls.items():
        left, kept = seconds, []
        for test in sorted(tests, key=lambda test: took.get(test, 0.0)):
            left -= took.get(test, 0.0)
            if kept and left < 0.0:
                break
            kept.append(test)
        calls[name] = kept
    return stats


def change(module: str, name: str) -> list[str]:
    """Lines that a mutant takes away (-) and puts in (+)."""
    code = (MISSION / f"{module}.py").read_text()
    short = name.rpartition(".")[2]
    was, now = (_body(code, f) for f in (re.sub(r"__mutmut_\d+$", "__mutmut_orig", short), short))
    lines = difflib.unified_diff(was, now, lineterm="", n=0)
    return [f"{line[0]} {line[1:].strip()}" for line in lines if line[0] in "+-" and line[:3] not in {"+++", "---"}]


def _body(code: str, function: str) -> list[str]:
    found = re.search(rf"^( *)def {re.escape(function)}\(.*?(?=^\1\S(?<![)])|\Z)", code, re.DOTALL | re.MULTILINE)
    return [] if found is None else found[0].split("\n")[1:]


def _counts(lines: list[str]) -> bool:
    """Whether anything but the words of a sentence differs."""
    was, now = ([_STRINGS.sub('""', line[1:]) for line in lines if line[0] == sign] for sign in "-+")
    return was != now


def _function(name: str) -> str:
    """Name in the source: mutmut puts x_ before it, and methods' classes between two marks of its own."""
    return re.sub(r"__mutmut_\d+$", "", name.rpartition(".")[2]).removeprefix("x_")


def _codes(module: str) -> dict[str, int | None]:
    return json.loads((MISSION / f"{module}.py.meta").read_text())["exit_code_by_key"]


def _mutmut(*names: str) -> None:
    subprocess.run([sys.executable, "-m", "mutmut", "run", "--max-children", "1", *names], check=True)


if __name__ == "__main__":
    main()
