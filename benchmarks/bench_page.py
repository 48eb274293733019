"""How many pictures a second does the page of thermosplat-export --format html show, and what takes the time?

    python benchmarks/bench_page.py scene.html [before.html ...] [--size 640x360] [--rounds 5] [--pictures 12]

Opens each page in headless Chromium, whose WebGL runs in software, and draws its layers from views of the capture one
after the other: each from another place, so that colours, order and picture are made anew. The pages take turns. Prints
medians of the rounds: pictures a second, seconds of processor for one (of the browser and all its processes), and of
another picture the milliseconds until each kind of WebGL call is done; the rest is JavaScript, the sorting above all.
"""

import argparse
import os
import statistics
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "fixtures"))

_WAIT = """
  const drawn = document.getElementById("picture").getContext("webgl2");
  const wait = () => drawn.readPixels(0, 0, 1, 1, drawn.RGBA, drawn.UNSIGNED_BYTE, new Uint8Array(4));
"""
_DRAW = """
  const [layer, from, count, [width, height]] = given;
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const select = document.getElementById("first");
  select.value = layer;
  const draw = (number) => {
    const { viewmat, fov } = scene.views[number % scene.views.length];
    const focal = height / (2 * Math.tan((fov * Math.PI) / 360));
    window.thermosplat.look(viewmat, [focal, focal], [width / 2, height / 2], [width, height]);
    wait();
  };
"""
_PICTURES = f"""(given) => {{ {_WAIT} {_DRAW}
  draw(from);
  const start = performance.now();
  for (let k = 1; k <= count; k++) draw(from + k);
  return (performance.now() - start) / count;
}}"""
_PARTS = f"""(given) => {{ {_WAIT} {_DRAW}
  const spent = {{ blending: 0, "other drawing": 0, upload: 0 }}, kept = {{}};
  const names = {{ drawElements: "blending", drawArrays: "other drawing", texSubImage2D: "upload" }};
  const waitHere = () => {{
    const bound = drawn.getParameter(drawn.FRAMEBUFFER_BINDING);
    drawn.bindFramebuffer(drawn.FRAMEBUFFER, null);
    wait();
    drawn.bindFramebuffer(drawn.FRAMEBUFFER, bound);
  }};
  draw(from);
  for (const [call, name] of Object.entries(names)) {{
    kept[call] = drawn[call];
    drawn[call] = (...what) => {{
      waitHere();
      const start = performance.now();
      kept[call].apply(drawn, what);
      waitHere();
      spent[name] += performance.now() - start;
    }};
  }}
  const start = performance.now();
  for (let k = 1; k <= count; k++) draw(from + k);
  spent.rest = performance.now() - start - Object.values(spent).reduce((sum, one) => sum + one);
  for (const call of Object.keys(names)) delete drawn[call];
  return Object.fromEntries(Object.entries(spent).map(([name, sum]) => [name, sum / count]));
}}"""


def processor_seconds() -> float:
    """Of this process and all that it started, which are there still (Linux)."""
    spent, parents = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended
        spent[int(folder.name)] = int(fields[11]) + int(fields[12])
        parents[int(folder.name)] = int(fields[1])

    def is_ours(process: int) -> bool:
        while process not in (0, os.getpid()):
            process = parents.get(process, 0)
        return process != 0

    return sum(ticks for process, ticks in spent.items() if is_ours(process)) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--pictures", type=int, default=12, help="in a round")
    arguments = parser.parse_args()
    from headless_browser import browser  # of tests/fixtures, and needs pytest and playwright

    size = [int(side) for side in arguments.size.split("x")]
    rows: dict[tuple[Path, str], list[dict[str, Any]]] = {}
    with browser() as running:
        tabs = {}
        for path in arguments.pages:
            tabs[path] = running.new_context(viewport={"width": size[0], "height": size[1]}).new_page()
            tabs[path].goto(path.absolute().as_uri())
            tabs[path].wait_for_selector("html[data-ready='1']", timeout=120_000)
        for number in range(arguments.rounds):
            for path, tab in tabs.items():
                for layer, name in enumerate(tab.evaluate("() => thermosplat.layers.map((layer) => layer.key)")):
                    given, before = [layer, number, arguments.pictures, size], processor_seconds()
                    each = tab.evaluate(_PICTURES, given)
                    spent = (processor_seconds() - before) / (arguments.pictures + 1)
                    parts = tab.evaluate(_PARTS, given)
                    row = {"pictures a second": 1000 / each, "processor seconds": spent, **parts}
                    rows.setdefault((path, name), []).append(row)
    names = list(next(iter(rows.values()))[0])
    print(f"| page | layer | {' | '.join(names)} |\n|{'---|' * (len(names) + 2)}")
    for (path, layer), measured in rows.items():
        cells = [f"{statistics.median(row[name] for row in measured):.3g}" for name in names]
        print(f"| {path.name} | {layer} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
