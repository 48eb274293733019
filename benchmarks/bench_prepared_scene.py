"""Does a scene that thermosplat-prepare made train as well as one that was prepared by hand?

    thermosplat-prepare arco_castle_rgbt/original --out captures/arco
    python benchmarks/bench_prepared_scene.py arco_castle_rgbt/scene_640x480 captures/arco -- --config demo \
        --data-factor 4 --max-steps 1200

Both are brought to the same views and to thermal images of the same counts (``preparation/same_views.py``): the one by
hand as it is, the other with its own poses, lenses and rig. Both are trained with the flags after ``--`` for each of
``--seeds``. Prints held-out PSNR and writes prepared_scene.json.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from preparation.same_views import HandMade, write_capture_as_scene, write_scene_as_shown
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.runs.atomic_writes import write_text


def trained(data: Path, result: Path, seed: int, flags: list[str]) -> dict[str, Any]:
    """Metrics of one training."""
    words = [str(data), "--result-dir", str(result), "--seed", str(seed), "--overwrite", *flags]
    subprocess.run([sys.executable, "-m", "thermosplat.cli.train", *words], check=True)
    metrics: dict[str, Any] = json.loads((result / "metrics.json").read_text())
    return metrics


def main() -> None:
    """Bring both to the same views, train them, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="the scene that was prepared by hand, with its scene.json")
    parser.add_argument("capture", type=Path, help="what thermosplat-prepare made of the same files")
    parser.add_argument("--seeds", nargs="+", type=int, default=[42])
    parser.add_argument("--out", type=Path, default=Path("results/prepared_scene"))
    words, flags = sys.argv[1:], []
    if "--" in words:
        words, flags = words[: words.index("--")], words[words.index("--") + 1 :]
    arguments = parser.parse_args(words)
    scene = HandMade.read(arguments.scene)
    write_scene_as_shown(scene, arguments.out / "by_hand")
    left = write_capture_as_scene(CaptureFolder(arguments.capture), scene, arguments.out / "by_command")
    print(f"Counts are corrected as the scene's are, but for {left:.1f} counts.")
    rows = []
    print("| seed | prepared | RGB PSNR | thermal PSNR |\n|---|---|---|---|")
    for seed in arguments.seeds:
        for way in ("by_hand", "by_command"):
            metrics = trained(arguments.out / way, arguments.out / f"{way}_{seed}", seed, flags)
            rows.append({"seed": seed, "prepared": way, "rgb": metrics["rgb"], "thermal": metrics["thermal"]})
            print(f"| {seed} | {way} | {metrics['rgb']['psnr']:.2f} | {metrics['thermal']['psnr']:.2f} |", flush=True)
            report = {"command": sys.argv, "unexplained_counts": left, "rows": rows}
            write_text(arguments.out / "prepared_scene.json", json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
