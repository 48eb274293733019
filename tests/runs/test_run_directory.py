"""A run folder is started once, found again, and never overwritten by accident."""

import json
from pathlib import Path

import pytest
import torch

from thermosplat.errors import UserError
from thermosplat.runs.run_directory import RunDirectory, checkpoint_step


def _finished_run(path: Path, step: int = 30_000) -> RunDirectory:
    run = RunDirectory.create(path)
    run.checkpoint(step).write_bytes(b"x")
    run.metrics_jsonl.write_text("{}\n")
    (run.renders / "a_1.png").write_bytes(b"x")
    (run.stats / "per_view.csv").write_text("frame,modality\na/1,rgb\n")
    return run


def test_second_run_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    """The message says how far the run there is, and the three ways on, the one that harms nothing first."""
    _finished_run(tmp_path / "shed")
    with pytest.raises(UserError, match=r"shed already holds a run \(30,000 steps\)") as caught:
        RunDirectory.create(tmp_path / "shed")
    assert "--resume" in caught.value.hint
    assert "--overwrite" in caught.value.hint
    assert "--result-dir NEW" in caught.value.hint


def test_overwrite_deletes_the_run_and_nothing_else(tmp_path: Path) -> None:
    """Files that no run wrote survive --overwrite."""
    _finished_run(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    run = RunDirectory.create(tmp_path, overwrite=True)
    assert not run.holds_a_run()
    assert [entry.name for entry in tmp_path.iterdir()] == ["notes.txt"]


def test_overwrite_leaves_what_other_trainers_wrote(tmp_path: Path) -> None:
    """gsplat's trainer has the same folders; its files in them, and a user's, survive, whatever of ours lies beside."""
    _finished_run(tmp_path)
    ours = [
        *("ckpts/.step_000100.4711.tmp.pt", "stats/step_000100.json", "stats/eval_000100.csv"),
        *("stats/eval_000100_shed.json", "stats/regions_000100_shed.json", "renders/eval_000100/b.png"),
        *("renders/eval_000100_shed/b.png", "ply/splat_rgb.ply", "videos/ellipse_both_000100.mp4"),
        *("ply/splat_nir.ply", "videos/interp_rgb-nir-red_edge_000100.mp4", "refined/cameras.txt"),
        *("exports/splat_rgb.compressed.ply", "ply/geo.json", "exports/orthomosaic_thermal.tif"),
        *("stats/.eval_000100.0123456789abcdef.tmp.json", "renders/eval_000100/.a.0123456789abcdef.tmp.png"),
        *("videos/test_rgb_000100_shed/desk_0001.png", "tb/events.out.tfevents.17.host.1.0.thermosplat", "config.yaml"),
    ]
    theirs = [
        *("ckpts/ckpt_6999_rank0.pt", "stats/val_step6999.json", "renders/val_step6999_0000.png", "renders/mine/b.png"),
        *(
            "ply/point_cloud_6999.ply",
            "exports/scene.glb",
            "videos/traj_6999.mp4",
            "videos/train_my_clip_1.mp4",
            "tb/events.out.tfevents.17.host.1.0",
            "cfg.yml",
        ),
    ]
    for name in (*ours, *theirs):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).write_bytes(b"x")
    RunDirectory.create(tmp_path, overwrite=True)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert left == set(theirs)
    assert not (tmp_path / "renders" / "eval_000100").exists()


@pytest.mark.parametrize("folder", ["ckpts", "stats", "renders", "ply", "exports", "videos", "refined", "tb"])
def test_nothing_is_deleted_or_written_through_a_link(tmp_path: Path, folder: str) -> None:
    """A folder of the run that leads outside is refused by --overwrite and by what writes there."""
    run = _finished_run(tmp_path / "run")
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "per_view.csv").write_text("mine")
    (outside / "step_000100.pt").write_text("mine")
    (tmp_path / "run" / folder).rename(tmp_path / "kept") if (tmp_path / "run" / folder).exists() else None
    (tmp_path / "run" / folder).symlink_to(outside)
    with pytest.raises(UserError, match=f"{folder} is a link"):
        RunDirectory.create(tmp_path / "run", overwrite=True)
    with pytest.raises(UserError, match=f"{folder} is a link"):
        getattr(run, folder)
    run.sweep()
    assert {entry.name: entry.read_text() for entry in outside.iterdir()} == {
        "per_view.csv": "mine",
        "step_000100.pt": "mine",
    }
    assert run.metrics_jsonl.is_file()


def test_a_linked_folder_of_pictures_loses_its_link_only(tmp_path: Path) -> None:
    """--overwrite takes the link away that has the name of one of our folders; pictures outside stay."""
    run = _finished_run(tmp_path / "run")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a.png").write_bytes(b"x")
    (run.renders / "eval_000100").symlink_to(tmp_path / "mine")
    with pytest.raises(UserError, match="eval_000100 is a link"):
        run.pictures("renders", "eval_000100")
    RunDirectory.create(tmp_path / "run", overwrite=True)
    assert [entry.name for entry in (tmp_path / "mine").iterdir()] == ["a.png"]
    assert not (tmp_path / "run" / "renders").exists()


def test_what_killed_runs_left_is_swept_everywhere(tmp_path: Path) -> None:
    """Temporary files of all folders go, those of other names stay."""
    run = _finished_run(tmp_path)
    name = ".a.0123456789abcdef.tmp.png"
    folders = [tmp_path, run.ckpts, run.pictures("renders", "eval_000100"), run.pictures("videos", "interp_rgb_000100")]
    for folder in folders:
        (folder / name).write_bytes(b"x")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / name).write_bytes(b"x")
    run.sweep()
    assert [path.parent for path in tmp_path.rglob(name)] == [tmp_path / "mine"]


def test_folder_with_other_files_can_be_used(tmp_path: Path) -> None:
    """Only a run is in the way of a run."""
    (tmp_path / "notes.txt").write_text("mine")
    assert RunDirectory.create(tmp_path).path == tmp_path


def test_result_folder_in_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell leaves the ~ of --result-dir=~/shed to the program: no folder is to be called ~."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert RunDirectory.create("~/shed").path == tmp_path / "shed"


def test_file_in_the_way_is_explained(tmp_path: Path) -> None:
    """A result folder cannot be made where there is a file."""
    (tmp_path / "out").write_text("")
    with pytest.raises(UserError, match="out is a file"):
        RunDirectory.create(tmp_path / "out")
    with pytest.raises(UserError, match="Could not make the result folder"):
        RunDirectory.create(tmp_path / "out" / "deeper")


def test_open_asks_for_a_run(tmp_path: Path) -> None:
    """A folder without a run, and no folder, are told apart."""
    with pytest.raises(UserError, match="the folder holds no run"):
        RunDirectory.open(tmp_path)
    with pytest.raises(UserError, match="there is no such folder"):
        RunDirectory.open(tmp_path / "absent")
    (tmp_path / "splat.ply").write_text("")
    with pytest.raises(UserError, match="that is a file"):
        RunDirectory.open(tmp_path / "splat.ply")
    _finished_run(tmp_path)
    assert RunDirectory.open(tmp_path).path == tmp_path


def test_latest_checkpoint_goes_by_number(tmp_path: Path) -> None:
    """More steps win, also where the number outgrows its padding; other files are no checkpoints."""
    run = RunDirectory.create(tmp_path)
    assert run.latest_checkpoint() is None
    for step in (7_000, 1_000_000, 999_999):
        run.checkpoint(step).write_bytes(b"x")
    (run.ckpts / ".step_2000000.17.tmp.pt").write_bytes(b"x")
    (run.ckpts / "step_best.pt").write_bytes(b"x")
    latest = run.latest_checkpoint()
    assert latest is not None
    assert checkpoint_step(latest) == 1_000_000


def test_checkpoint_step_reads_our_names_only() -> None:
    """A file that is named otherwise has no step."""
    assert checkpoint_step(Path("step_000411.pt")) == 411
    with pytest.raises(ValueError, match=r"step_<number>\.pt"):
        checkpoint_step(Path("final.pt"))


def test_folders_exist_when_asked_for(tmp_path: Path) -> None:
    """Every folder property gives a folder one can write into, of its own name."""
    run = RunDirectory.create(tmp_path)
    assert list(tmp_path.iterdir()) == []
    for name in ("ckpts", "stats", "renders", "ply", "exports", "videos", "tb"):
        assert getattr(run, name).is_dir()
        assert getattr(run, name).name == name


def test_a_file_in_place_of_a_folder_is_explained(tmp_path: Path) -> None:
    """Where a folder of the run cannot be made, the message names it."""
    run = RunDirectory.create(tmp_path)
    (tmp_path / "videos").write_text("")
    with pytest.raises(UserError, match=r"Could not make the folder .*videos: File exists"):
        _ = run.videos


def test_json_has_no_nan(tmp_path: Path) -> None:
    """Numbers that JSON lacks become null, in nested values too."""
    run = RunDirectory.create(tmp_path)
    run.write_json(run.metrics_json, {"a": float("nan"), "b": [float("inf"), 1.5], "c": {"d": None}})
    assert json.loads(run.metrics_json.read_text()) == {"a": None, "b": [None, 1.5], "c": {"d": None}}


def test_environment_names_versions_and_no_paths(tmp_path: Path) -> None:
    """environment.json traces numbers to versions and device without telling where files lie."""
    run = RunDirectory.create(tmp_path)
    run.write_environment(torch.device("cpu"))
    text = run.environment_json.read_text()
    environment = json.loads(text)
    assert environment["packages"]["torch"] == torch.__version__
    assert environment["torch_threads"] == torch.get_num_threads()
    assert environment["device"].startswith("CPU")
    assert str(tmp_path) not in text
    assert str(Path.home()) not in text


def test_resume_command_can_be_pasted() -> None:
    """A path with a blank is quoted."""
    assert RunDirectory("my runs/shed").resume_command() == "thermosplat-train --resume 'my runs/shed'"
    assert RunDirectory("shed", devices=4).resume_command() == "thermosplat-train --resume shed --devices 4"


@pytest.mark.parametrize(
    ("content", "stays"), [("<!doctype html>\n<!-- results of thermosplat -->", False), ("mine", True)]
)
def test_only_our_page_is_deleted(tmp_path: Path, content: str, stays: bool) -> None:
    """--overwrite deletes an index.html that a command wrote, and no other; neither makes a folder a run."""
    (tmp_path / "index.html").write_text(content)
    assert not RunDirectory(tmp_path).holds_a_run()
    _finished_run(tmp_path)
    RunDirectory.create(tmp_path, overwrite=True)
    assert (tmp_path / "index.html").exists() is stays
