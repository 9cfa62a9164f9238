"""How large the project is, and what one image passes on its way through it.

python benchmarks/structure.py                  # lines, files, names, imports
python benchmarks/structure.py MODEL RECORDING  # also the files that one image of a recording passes
"""

from __future__ import annotations

import argparse
import ast
import io
import subprocess
import sys
import threading
import tokenize
from collections.abc import Callable
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "conformodal"
VAGUE = ("found", "its", "own", "known")
_NOT_CODE = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING)


def lines_in(folder: Path) -> int:
    """Lines of Python."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob("*.py"))


def code_lines(text: str) -> int:
    """Lines with code: without blank lines, comments and docstrings."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            docstrings |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    used: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NOT_CODE and token.type != tokenize.ENDMARKER:
            used |= set(range(token.start[0], token.end[0] + 1))
    return len(used - docstrings)


def vague_names(text: str) -> int:
    """Bindings of names that say nothing."""
    nodes = ast.walk(ast.parse(text))
    return sum(
        (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in VAGUE)
        or (isinstance(node, ast.arg) and node.arg in VAGUE)
        for node in nodes
    )


def imported_by(module: str) -> list[Path]:
    """Files of the package that are loaded when a module is imported in a fresh process."""
    code = f"import sys, {module}; print(*(m.__file__ for k, m in sys.modules.items() if k.startswith('conformodal')))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return [Path(line) for line in done.stdout.split()]


def files_of_one_image(model: Path, recording: Path) -> list[str]:
    """Files of the package with a function that runs while the twentieth image of a recording is answered."""
    from conformodal import VisualOdometry, read_recording  # noqa: PLC0415 - slow, and not always wanted

    odometry, images = VisualOdometry.load(model), read_recording(recording)
    passed: set[str] = set()

    def note(frame: FrameType, event: str, argument: object) -> None:
        path = frame.f_code.co_filename
        if event == "call" and path.startswith(str(SOURCE)):
            passed.add(str(Path(path).relative_to(SOURCE)))

    watch: Callable[[FrameType, str, object], None] = note
    for i in range(20):
        image, time_s = images.image(i), float(images.timestamps_s[i])
        if i == 19:
            threading.setprofile(watch)
            sys.setprofile(watch)
        odometry.step(image, time_s)
        sys.setprofile(None)
        threading.setprofile(None)
    return sorted(passed)


def main() -> None:
    """Print all numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", type=Path)
    parser.add_argument("recording", nargs="?", type=Path)
    options = parser.parse_args()
    texts = [path.read_text(encoding="utf-8") for path in SOURCE.rglob("*.py")]
    print(f"source: {lines_in(SOURCE)} lines, {sum(map(code_lines, texts))} of code, {len(texts)} files")
    used = [len(line) for text in texts for line in text.splitlines() if line.strip()]
    print(f"mean length of a line that is not blank: {sum(used) / len(used):.1f}")
    print(f"names {', '.join(VAGUE)}: {sum(map(vague_names, texts))}")
    for folder in ("tests", "benchmarks", "experiments", "scripts"):
        print(f"{folder}: {lines_in(ROOT / folder)} lines")
    files = imported_by("conformodal.cli.run")
    n_lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)
    print(f"conformodal.cli.run imports {len(files)} files, {n_lines} lines")
    if options.model and options.recording:
        passed = files_of_one_image(options.model, options.recording)
        print(f"one image passes {len(passed)} files: {', '.join(passed)}")


if __name__ == "__main__":
    main()
