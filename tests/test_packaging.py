"""What an installation must bring along, and what the project says of itself in several places."""

import ast
import importlib.metadata
import importlib.resources
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

import thermosplat
from thermosplat.config.files import preset_paths
from thermosplat.datasets import load_capture

REPOSITORY = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
_FOR_DEVELOPERS = ("test", "docs", "dev")


def test_one_version_everywhere() -> None:
    """Package, pyproject.toml, changelog and citation name the same version."""
    assert PROJECT["version"] == thermosplat.__version__
    changelog = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    releases = re.findall(r"^## \[(\d[^]]*)\] - (\d{4}-\d\d-\d\d)$", changelog, re.MULTILINE)
    assert releases[0][0] == thermosplat.__version__
    citation = (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {thermosplat.__version__}\n" in citation
    assert f'date-released: "{releases[0][1]}"' in citation


def test_one_range_of_python_versions_everywhere() -> None:
    """pyproject.toml installs on the versions that its classifiers, the documents and continuous integration name."""
    classified = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if "Python :: 3." in line]
    first, last = classified[0], classified[-1]
    assert PROJECT["requires-python"] == f">={first},<3.{int(last.removeprefix('3.')) + 1}"
    for name in ("README.md", "docs/index.md", ".ci/run"):
        assert f"Python {' or '.join(classified)}" in (REPOSITORY / name).read_text(encoding="utf-8")


def test_the_workflow_runs_everything_on_these_versions() -> None:
    """GitHub gives the command that a developer gives, with every version of Python that is classified."""
    (job,) = yaml.safe_load((REPOSITORY / ".github/workflows/ci.yml").read_text(encoding="utf-8"))["jobs"].values()
    classified = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if "Python :: 3." in line]
    assert job["strategy"]["matrix"]["python"] == classified
    assert "bash .ci/run" in [step.get("run") for step in job["steps"]]


def test_a_bug_report_asks_for_what_is_needed() -> None:
    """The version, the command, the message and environment.json, none of which may be left out."""
    form = yaml.safe_load((REPOSITORY / ".github/ISSUE_TEMPLATE/bug.yml").read_text(encoding="utf-8"))
    required = {field["id"] for field in form["body"] if field.get("validations", {}).get("required")}
    assert {"version", "command", "message", "environment"} <= required


def test_public_names_are_listed_before_they_are_loaded() -> None:
    """`dir(thermosplat)` has the lazy names too, without loading torch; each of them can be imported."""
    code = "import sys, thermosplat; print(*dir(thermosplat)); assert 'torch' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {"PairCapacity", "RGBTRender", "rasterization", "rasterization_rgbt"} <= set(thermosplat.__all__)
    assert set(thermosplat.__all__) <= set(done.stdout.split())
    assert all(getattr(thermosplat, name) is not None for name in thermosplat.__all__)
    with pytest.raises(AttributeError, match="no attribute 'splat'"):
        thermosplat.splat  # noqa: B018


def test_the_commands_are_installed() -> None:
    """Every script of pyproject.toml is an entry point of the installed package and can be loaded."""
    try:
        distribution = importlib.metadata.distribution("thermosplat")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("thermosplat is not installed, only on the path")
    scripts = {entry.name: entry for entry in distribution.entry_points if entry.group == "console_scripts"}
    assert set(scripts) == set(PROJECT["scripts"])
    for name, entry in scripts.items():
        assert entry.value == PROJECT["scripts"][name]
        assert callable(entry.load())


def test_the_data_files_are_found() -> None:
    """Presets, sample capture, LPIPS heads and the typing marker lie where the code looks for them."""
    configs = {path.stem for path in (REPOSITORY / "configs").rglob("*.yaml")}
    assert set(preset_paths()) == configs
    assert len(load_capture("sample").train) == 42
    assert importlib.resources.files(thermosplat).joinpath("py.typed").is_file()
    heads = importlib.resources.files("thermosplat").joinpath("image_quality", "lpips_heads")
    assert {path.name for path in heads.iterdir()} >= {"alex.pth", "vgg.pth", "LICENSE.txt"}


def test_all_imported_packages_are_declared() -> None:
    """Third-party modules that the package imports are dependencies, or extras imported where they are used."""
    modules = {"yaml": "PyYAML", "cv2": "opencv-contrib-python-headless", "warp": "warp-lang", "PIL": "Pillow"}
    modules |= {"jpeg_ls": "pyjpegls", "pxr": "usd-core", "skimage": "scikit-image"}
    extras = {name: lines for name, lines in PROJECT["optional-dependencies"].items() if name not in _FOR_DEVELOPERS}
    declared = PROJECT["dependencies"] + [line for lines in extras.values() for line in lines]
    names = {re.split(r"[<>=\[;]", line)[0].lower() for line in declared}
    files = [path for folder in ("src/thermosplat", "warp_kernels") for path in (REPOSITORY / folder).rglob("*.py")]
    imported = {module for path in files for module in _imports(path)}
    own = {"thermosplat", "warp_kernels"}
    third_party = imported - sys.stdlib_module_names - own
    missing = {module for module in third_party if _distribution(module, modules) not in names}
    assert {"torch", "numpy", "warp", "kornia", "cv2", "pycolmap", "tyro", "rich", "yaml"} <= third_party
    assert not missing


def _imports(path: Path) -> Iterator[str]:
    """Top-level names of the modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.split(".")[0]


def _distribution(module: str, modules: dict[str, str]) -> str:
    return modules.get(module, module.replace("_", "-")).lower()


@pytest.mark.slow
def test_the_wheel_is_complete(tmp_path: Path) -> None:
    """A wheel has the code, the data files and the licences, and nothing else."""
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--wheel-dir", str(tmp_path), str(REPOSITORY)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = tmp_path.glob("thermosplat-*-py3-none-any.whl")
    names = set(zipfile.ZipFile(wheel).namelist())

    def sources(folder: str, prefix: str) -> set[str]:
        files = (path for path in (REPOSITORY / folder).rglob("*") if path.is_file() and path.suffix != ".pyc")
        return {prefix + path.relative_to(REPOSITORY / folder).as_posix() for path in files}

    expected = sources("src/thermosplat", "thermosplat/") | sources("warp_kernels", "warp_kernels/")
    expected |= sources("configs", "thermosplat/configs/")
    metadata = {name for name in names if name.startswith("thermosplat-")}
    assert names - metadata == expected
    assert "thermosplat/sample/sparse/0/points3D.bin" in names
    legal = {Path(name).name for name in metadata if "/licenses/" in name}
    assert legal == {"LICENSE", "NOTICE", "LICENSE.txt"}
    assert f"thermosplat-{thermosplat.__version__}.dist-info/entry_points.txt" in metadata
    assert wheel.stat().st_size < 4_000_000, "the sample capture may take about 2 MB"
