"""`python -m tests.cases [FOLDER]`: the folders of files from the field, a line each; 1 if one is wrong."""

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from shards.printable import printable
from tests.cases import folders, objects_gltf, objects_obj, objects_ply_stl, videos, weights
from tests.cases.outcome import Case, Outcome, outcome_of

__all__ = ["CASES", "main"]

# One module for each part of the files; a folder that none of them names is reported.
CASES: tuple[Case, ...] = (
    *folders.CASES,
    *objects_gltf.CASES,
    *objects_obj.CASES,
    *objects_ply_stl.CASES,
    *videos.CASES,
    *weights.CASES,
)
DEFAULT_FOLDER = Path("../shared/cases")


def main(arguments: Sequence[str], cases: Sequence[Case] = CASES) -> int:
    """Print the outcomes and their counts; the exit status."""
    root = Path(arguments[0]) if arguments else DEFAULT_FOLDER
    if not root.is_dir():
        print(f"{root}: there is no such folder; expected one with a folder for each case")
        return 2
    width = max((len(case.folder) for case in cases), default=0)
    outcomes = []
    for case in sorted(cases, key=lambda case: case.folder):
        outcomes.append(outcome_of(case, root))
        print(_line(outcomes[-1], width), flush=True)
    for folder in _without_row(root, cases):
        outcomes.append(Outcome(case=folder, status="wrong", line="no row", seconds=0.0))
        print(_line(outcomes[-1], width), flush=True)
    counts = Counter(outcome.status for outcome in outcomes)
    print(", ".join(f"{counts[status]} {status}" for status in ("right", "refused", "wrong", "traceback")))
    return 0 if outcomes and all(outcome.is_good for outcome in outcomes) else 1


def _line(outcome: Outcome, width: int) -> str:
    text = f"{outcome.status:9}  {outcome.case:{width}}  {outcome.line}  ({outcome.seconds:.1f} s)"
    return printable(text)


def _without_row(root: Path, cases: Sequence[Case]) -> list[str]:
    named = {case.folder for case in cases}
    return sorted(path.name for path in root.iterdir() if path.is_dir() and path.name not in named)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
