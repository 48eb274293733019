"""The command line of thermosplat-train: presets, flags on top, resuming, help."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.config import TrainConfig
from thermosplat.config.files import load_config, to_yaml
from thermosplat.config.run_schedule import in_steps
from thermosplat.errors import UserError
from toy_scene import with_spectra


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A result folder as an interrupted run leaves it, as far as the command line looks."""
    folder = tmp_path / "shed"
    folder.mkdir()
    config = replace(load_config("demo"), data="data/shed", result_dir=str(folder), sh_degree=2)
    (folder / "config.yaml").write_text(to_yaml(config))
    return folder


def test_flags_override_the_preset() -> None:
    """Flags change single values of the preset that --config names, wherever it stands."""
    config = parse_train_arguments(["data/shed", "--max-steps", "9", "--config", "3dgs", "--loss.ssim-lambda", "0.5"])
    expected = load_config("3dgs")
    assert config == replace(expected, data="data/shed", max_steps=9, loss=replace(expected.loss, ssim_lambda=0.5))


@pytest.mark.parametrize("flag", ["--max-steps=7000", "--max_steps=7000"])
def test_steps_that_are_given_are_meant(flag: str) -> None:
    """Whatever the capture's images, unless what they ask for is given, too; other flags change nothing."""
    seeded = parse_train_arguments(["data/shed", "--seed", "1"])
    assert (seeded.steps_for_views, seeded.noisy_steps) == (45, 1.5)
    given = parse_train_arguments(["data/shed", flag])
    assert (given.steps_for_views, given.noisy_steps) == (None, 1.0)
    both = parse_train_arguments(["data/shed", flag, "--steps-for-views", "10", "--noisy-steps", "2"])
    assert (both.steps_for_views, both.noisy_steps) == (10, 2.0)


def test_sample_takes_the_demo_preset() -> None:
    """The sample capture trains with the short schedule unless a preset is named; other data with our own best."""
    assert parse_train_arguments(["sample"]) == replace(load_config("demo"), data="sample")
    assert parse_train_arguments(["sample", "--config", "thermosplat"]) == replace(TrainConfig(), data="sample")
    assert parse_train_arguments(["data/shed"]) == replace(load_config("thermosplat_plus"), data="data/shed")


def test_resolved_config_reproduces_the_run(tmp_path: Path) -> None:
    """A run's config.yaml, given as --config, asks for the same run."""
    config = parse_train_arguments(["data/shed", "--config", "demo", "--seed", "3", "--eval-steps", "5", "10"])
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(config))
    assert parse_train_arguments(["--config", str(path)]) == config


def test_files_are_found_from_anywhere(run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Palette and LPIPS weights are kept by absolute paths; the same relative one on --resume contradicts nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    flags = ["--thermal.palette", "hot.csv", "--lpips-weights", "~/vgg.pth"]
    config = parse_train_arguments(["data/shed", *flags])
    assert config.spectra["thermal"].palette == str(tmp_path / "hot.csv")
    assert config.lpips_weights == str(tmp_path / "home" / "vgg.pth")
    trained = replace(load_config(run_folder / "config.yaml"), spectra=config.spectra)
    (run_folder / "config.yaml").write_text(to_yaml(trained))
    assert parse_train_arguments(["--resume", str(run_folder), *flags]).spectra == config.spectra


@pytest.mark.parametrize(
    "flags",
    [
        "--result-dir x --max-steps 3 --data-factor 2 --test-every 4 --sh-degree 1 --device cpu --seed 1",
        "--thermal.source raw --thermal.unit centikelvin --thermal.range 10 30 --thermal.aligned",
        "--spectra.thermal.source raw --spectra.thermal.no-aligned --spectra.rgb.loss 0.5",
        "--model.gaussian-sets separate --model.feature-dim 0 --thermal.opacity shared "
        "--loss.depth-spread 0 --thermal.swept-depth 0 --thermal.point-spread 0",
        "--without thermal",
        "--densification.max-gaussians 1000 --optimizer.means-lr 1e-4 --decoder.no-modulation --overwrite",
    ],
)
def test_flags_have_the_documented_names(flags: str) -> None:
    """Flags named as gsplat's trainer names them, and the nested groups, are understood and change something."""
    assert parse_train_arguments(["data/shed", *flags.split()]) != parse_train_arguments(["data/shed"])


def test_no_capture() -> None:
    """Without a capture the message names the command for a first try."""
    with pytest.raises(UserError, match="No capture given") as caught:
        parse_train_arguments([])
    assert "thermosplat-train sample" in caught.value.hint


def test_presets_are_found_in_any_case() -> None:
    """A preset in capitals is a typo with a suggestion."""
    with pytest.raises(UserError, match='did you mean "3dgs"'):
        parse_train_arguments(["x", "--config", "3DGS"])


def test_file_cannot_ask_to_resume(tmp_path: Path) -> None:
    """What is checked when the flag is given would not be: the message names the flag."""
    (tmp_path / "mine.yaml").write_text("base: demo\nresume: results/my shed\n")
    with pytest.raises(UserError, match=r"mine\.yaml has resume: results/my shed") as caught:
        parse_train_arguments(["x", "--config", str(tmp_path / "mine.yaml")])
    assert "thermosplat-train --resume 'results/my shed'" in caught.value.hint


def test_impossible_flag_value() -> None:
    """Values out of range are refused with the flag's name."""
    with pytest.raises(UserError, match="--sh-degree must be at most 4, found 5"):
        parse_train_arguments(["x", "--sh-degree", "5"])


def test_typo_gets_a_suggestion(capsys: pytest.CaptureFixture[str]) -> None:
    """A mistyped flag ends with code 2 and the nearest flag."""
    with pytest.raises(SystemExit) as stop:
        parse_train_arguments(["x", "--max-step", "3"])
    assert stop.value.code == 2
    assert "--max-steps" in capsys.readouterr().err


@pytest.mark.rotating("commands in processes")
@pytest.mark.parametrize("command", ["train", "evaluate", "render", "export", "prepare", "benchmark"])
def test_help_imports_nothing_heavy(command: str) -> None:
    """--help of every command answers without torch, Warp, OpenCV, kornia or pycolmap."""
    script = (
        "import sys\n"
        f"from thermosplat.cli.{command} import main\n"
        "code = main(['--help'])\n"
        "print('heavy:', code, sorted({'torch', 'warp', 'cv2', 'kornia', 'pycolmap', 'numpy'} & set(sys.modules)))\n"
    )
    path = [str(Path(__file__).parents[2] / "src"), *sys.path]
    result = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {path!r}\n{script}"], capture_output=True, text=True
    )
    assert result.stdout.splitlines()[-1] == "heavy: 0 []", result.stderr
    assert "usage: thermosplat-" in result.stdout


def test_resume_takes_the_runs_configuration(run_folder: Path) -> None:
    """--resume needs no capture: everything comes from the run's config.yaml."""
    config = parse_train_arguments(["--resume", str(run_folder)])
    assert config == replace(load_config(run_folder / "config.yaml"), resume=str(run_folder))


def test_resume_knows_the_runs_spectra(run_folder: Path) -> None:
    """Flags of a spectrum that the run's configuration defines are compared with it."""
    config = with_spectra(load_config(run_folder / "config.yaml"), nir={"loss": 0.5})
    (run_folder / "config.yaml").write_text(to_yaml(config))
    assert parse_train_arguments(["--resume", str(run_folder), "--nir.loss", "0.5"]).spectra == config.spectra
    with pytest.raises(UserError, match=r"was trained with spectra\.nir\.loss=0\.5, the command asks for 1\.0"):
        parse_train_arguments(["--resume", str(run_folder), "--nir.loss", "1"])


def test_resume_may_go_on_longer(run_folder: Path) -> None:
    """More steps, another device and other reporting are no contradiction."""
    flags = ["--max-steps", "5000", "--device", "cpu", "--log-every", "7", "--config", "demo"]
    config = parse_train_arguments(["--resume", str(run_folder), *flags])
    assert (config.max_steps, config.device, config.log_every) == (5000, "cpu", 7)
    of_run = parse_train_arguments(["--resume", str(run_folder)])
    assert of_run.max_steps < 5000
    assert (in_steps(config).densification, config.sh_degree_interval) == (in_steps(of_run).densification, 170)


def test_resume_for_a_number_of_steps_ends_there(run_folder: Path) -> None:
    """Also where the run was to have as many as its images ask for."""
    (run_folder / "config.yaml").write_text(to_yaml(replace(load_config("thermosplat_plus"), data="data/shed")))
    assert parse_train_arguments(["--resume", str(run_folder)]).steps_for_views == 45
    longer = parse_train_arguments(["--resume", str(run_folder), "--max-steps", "20000"])
    assert (longer.max_steps, longer.steps_for_views, longer.noisy_steps) == (20_000, None, 1.0)


@pytest.mark.parametrize("flag", ["--data-factor", "--densification.max-gaussians", "--optimizer.means-lr"])
def test_resume_takes_the_remedies_that_errors_name(run_folder: Path, flag: str) -> None:
    """What the messages for full memory and NaN losses advise can be given together with --resume."""
    assert parse_train_arguments(["--resume", str(run_folder), flag, "3"]) != parse_train_arguments(
        ["--resume", str(run_folder)]
    )


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--sh-degree", "3"], "was trained with sh_degree=2, the command asks for 3"),
        (["--loss.features", "0.5"], "was trained with loss.features=1.0, the command asks for 0.5"),
        (["--thermal.loss", "0.5"], "was trained with spectra.thermal.loss=1.0, the command asks for 0.5"),
        (["--without", "thermal"], "was trained with without=(), the command asks for ('thermal',)"),
        (["--config", "3dgs"], "was trained with config=demo, the command asks for 3dgs"),
        (["--result-dir", "elsewhere"], "result_dir="),
        (["--max-steps", "10"], "the command asks for 10"),
        (["--overwrite"], "--overwrite deletes"),
    ],
)
def test_resume_refuses_contradictions(run_folder: Path, flags: list[str], expected: str) -> None:
    """A flag that contradicts the run is refused with both values."""
    with pytest.raises(UserError) as caught:
        parse_train_arguments(["--resume", str(run_folder), *flags])
    assert expected in caught.value.message
