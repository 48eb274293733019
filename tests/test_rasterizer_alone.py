"""The small distribution: the rasterizer where there are torch, NumPy and Warp, and nothing of the trainer."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import thermosplat

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "rasterizer_alone"
BUILD = tomllib.loads((FOLDER / "pyproject.toml").read_text(encoding="utf-8"))
WHOLE = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
FROM_THE_WHOLE = {"thermosplat.evaluation.loaded_run", "thermosplat.config"}
"""What it has not: behind a name of ``thermosplat``, which says so, and a type of the training's."""

RENDER = """
import importlib.util, importlib.metadata, sys
for name in ("pycolmap", "cv2", "kornia", "tyro", "yaml", "rich"):
    assert importlib.util.find_spec(name) is None, name
import torch, thermosplat
from thermosplat import SelectiveAdam, compute_relocation, fully_fused_projection, rasterization, rasterization_rgbt
from thermosplat.rasterizer import steps
assert "site-packages" in thermosplat.__file__, thermosplat.__file__
n = 4
gaussians = (torch.rand(n, 3), torch.rand(n, 4), torch.ones(n, 3), torch.ones(n), torch.ones(n, 3))
K = torch.tensor([[[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]])
image, _, info = rasterization(*gaussians, torch.eye(4)[None], K, 16, 16)
assert image.sum() > 0 and len(info["gaussian_ids"]) == n
try:
    thermosplat.load_run
except ImportError as error:
    print(error)
print(importlib.metadata.version("thermosplat-rasterizer"))
"""


def sources() -> dict[str, Path]:
    """Python files of the wheel by the names of their modules."""
    found = {}
    for given, inside in BUILD["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"].items():
        path = (FOLDER / given).resolve()
        for file in path.rglob("*.py") if path.is_dir() else [path]:
            within = Path(inside) / file.relative_to(path) if path.is_dir() else Path(inside)
            if file.suffix == ".py":
                found[".".join(within.with_suffix("").parts).removesuffix(".__init__")] = file
    return found


def test_it_imports_what_it_has() -> None:
    """Every module that a file of it imports is in it, or one of its three dependencies."""
    modules, missing = sources(), set()
    for name, path in modules.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported = [alias.name for alias in node.names]
            else:
                imported = [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            own = [one for one in imported if one.startswith(("thermosplat", "warp_kernels"))]
            missing |= {(name, one) for one in own if one not in modules}
            others = {one.partition(".")[0] for one in set(imported) - set(own)} - sys.stdlib_module_names
            missing |= {(name, one) for one in others - {"torch", "numpy", "warp"}}
    assert {imported for _, imported in missing} <= FROM_THE_WHOLE, missing


def test_its_bounds_are_lower_ones() -> None:
    """Those of the whole; what is newer, and has not been seen to break it, may be installed beside it."""
    needed = BUILD["project"]["dependencies"]
    assert [re.split(r"[<>=]", line)[0] for line in needed] == ["torch", "numpy", "warp-lang"]
    for line in needed:
        assert "<" not in line
        assert any(one == line or one.startswith(f"{line},") for one in WHOLE["project"]["dependencies"]), line
    assert WHOLE["project"]["requires-python"].startswith(BUILD["project"]["requires-python"] + ",")


def link_distribution(name: str, folder: Path, linked: set[str]) -> None:
    """Puts an installed distribution, and what it needs, into another environment's folder of packages."""
    if name in linked:
        return
    linked.add(name)
    distribution = importlib.metadata.distribution(name)
    for top in {file.parts[0] for file in distribution.files or [] if ".." not in file.parts}:
        if not (folder / top).exists() and top != "__pycache__":
            (folder / top).symlink_to(Path(str(distribution.locate_file(top))))
    for line in distribution.requires or []:
        requirement, _, marker = line.partition(";")
        needed = re.split(r"[\s<>=!~\[(]", requirement.strip())[0]
        if "extra" not in marker and _is_installed(needed):
            link_distribution(needed, folder, linked)


def _is_installed(name: str) -> bool:
    try:
        return importlib.metadata.distribution(name) is not None
    except importlib.metadata.PackageNotFoundError:
        return False


@pytest.mark.slow
def test_it_renders_beside_nothing_else(tmp_path: Path) -> None:
    """Its wheel, installed where torch, NumPy and Warp are, renders, and pip finds nothing missing."""
    python, wheels = tmp_path / "venv" / "bin" / "python", tmp_path / "wheels"

    alone = {"PATH": "/usr/bin:/bin", "HOME": str(Path.home())}

    def run(*command: str | Path) -> str:
        done = subprocess.run([*map(str, command)], capture_output=True, text=True, cwd=tmp_path, env=alone)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    (packages,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    linked: set[str] = set()
    for name in ("torch", "numpy", "warp-lang"):
        link_distribution(name, packages, linked)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--wheel-dir", str(wheels), str(FOLDER)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = wheels.glob("thermosplat_rasterizer-*-py3-none-any.whl")
    assert wheel.stat().st_size < 1_000_000
    run(python, "-m", "pip", "install", "--no-deps", "--no-index", wheel)
    assert "No broken requirements" in run(python, "-m", "pip", "check")
    said = run(python, "-c", RENDER)
    assert "thermosplat.load_run is not in thermosplat-rasterizer" in said
    assert said.split()[-1] == thermosplat.__version__
