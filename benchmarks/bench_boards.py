"""How exactly does ``thermosplat-prepare calibrate`` find lenses and rig, from pictures of a board?

    python benchmarks/bench_boards.py data/rig_desk/truth.json [--seeds 0 1 2] [--pictures 20] [--out results/boards]

The board is drawn as the cameras of truth.json see it, for each kind of board and each seed: blurred, noisy, and with
the dark squares warm (``tests/fixtures/seen_boards.py``). The command runs on the pictures as a user runs it. Prints
how far its cameras are from the true ones and writes boards.json. What truth.json has: ``preparation/rig_truth.py``.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from thermosplat.datasets.lens import Lens
from thermosplat.prepare.calibration.boards import Board
from thermosplat.prepare.calibration.calibration_file import RigCalibration, read_calibration
from thermosplat.runs.atomic_writes import write_text

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "fixtures"))

from seen_boards import write_boards

BOARDS = (Board("checkerboard", 8, 6, 0.04), Board("circles", 4, 9, 0.035), Board("charuco", 9, 6, 0.05, 0.038))
KINDS = tuple(board.kind for board in BOARDS)


def true_rig(truth_json: Path) -> RigCalibration:
    """The cameras of a rig's truth."""
    truth: dict[str, Any] = json.loads(truth_json.read_text())
    keys = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    lenses = [
        Lens("OPENCV", tuple(float(lens[key]) for key in keys), lens["width"], lens["height"])
        for lens in (truth["visible"], truth["thermal"])
    ]
    return RigCalibration(*lenses, np.linalg.inv(np.array(truth["thermal_to_visible"])))


def measured(rig: RigCalibration, board: Board, seed: int, pictures: int, folder: Path) -> dict[str, Any]:
    """Draw a board, calibrate, and compare."""
    shutil.rmtree(folder, ignore_errors=True)
    rgb, thermal = write_boards(folder / "boards", rig, board, pictures, seed)
    words = ["calibrate", folder / "capture", "--rgb", rgb, "--thermal", thermal, "--board", board.kind]
    words += ["--columns", board.columns, "--rows", board.rows, "--size", board.size]
    words += ["--marker", board.marker] if board.marker else []
    subprocess.run([sys.executable, "-m", "thermosplat.cli.prepare", *map(str, words)], check=True, capture_output=True)
    found = read_calibration(folder / "capture" / "calibration.json")
    assert found is not None
    turn = cv2.Rodrigues(found.thermal_from_rgb[:3, :3] @ rig.thermal_from_rgb[:3, :3].T)[0]
    away = found.thermal_from_rgb[:3, 3] - rig.thermal_from_rgb[:3, 3]
    return {
        "board": board.kind,
        "seed": seed,
        "rgb_focal": abs(found.rgb.params[0] / rig.rgb.params[0] - 1),
        "thermal_focal": abs(found.thermal.params[0] / rig.thermal.params[0] - 1),
        "degrees": float(np.degrees(np.linalg.norm(turn))),
        "millimetres": float(1000 * np.linalg.norm(away)),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    lines = [
        "| board | seed | RGB focal length [%] | thermal focal length [%] | rotation [°] | translation [mm] |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['board']} | {row['seed']} | {100 * row['rgb_focal']:.3f} | {100 * row['thermal_focal']:.3f} | "
        f"{row['degrees']:.3f} | {row['millimetres']:.2f} |"
        for row in rows
    ]
    return "\n".join(lines)


def main() -> None:
    """Calibrate with every board and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path, help="truth.json of a rig")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of poses of the board and of noise")
    parser.add_argument("--boards", nargs="+", choices=KINDS, default=KINDS, help="kinds of boards")
    parser.add_argument("--pictures", type=int, default=20, help="pairs of pictures of a board")
    parser.add_argument("--out", type=Path, default=Path("results/boards"), help="where pictures and captures go")
    arguments = parser.parse_args()
    rig = true_rig(arguments.truth)
    rows = [
        measured(rig, board, seed, arguments.pictures, arguments.out / f"{board.kind}_{seed}")
        for board in BOARDS
        if board.kind in arguments.boards
        for seed in arguments.seeds
    ]
    write_text(arguments.out / "boards.json", json.dumps({"command": sys.argv, "rows": rows}, indent=1))
    print(table(rows))


if __name__ == "__main__":
    main()
