"""Peers that are named on the command line: how missing ones are told, and what is compared of those that differ."""

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

import bench_rasterization
from measuring.agreement import OTHER_CONVENTIONS
from peers import gsplat_main
from peers.faster_gs import gradients_of_activated, raw_leaves, settings_of
from peers.installed import INSTALL, MAKERS, others
from peers.peer import Peer, RawParameters, Rendered, Tensors
from peers.renderers import thermosplat_peer
from rasterization.case import inputs_of, run_case
from repository_documents import REPOSITORY
from scenes.benchmark_scenes import synthetic_scene
from thermosplat import rasterization, spherical_harmonics

SIZE = (37, 21)


def test_missing_peers_are_one_line_each(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A line names the peer, the reason and the command that installs it; nobody else is asked."""
    for module in ("gsplat", "gswarp", "FasterGSCudaBackend"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delenv(gsplat_main.FOLDER, raising=False)
    assert others([*MAKERS, "torch"]) == []
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(MAKERS) == 4
    for name, line in zip(MAKERS, lines, strict=True):
        assert line.startswith(f"{name} is left out (")
        assert line.endswith(INSTALL[name])
    assert others(["torch"]) == []


def test_the_page_names_every_peer_and_its_licence() -> None:
    """Names of the command line, and a licence in the same row."""
    text = (REPOSITORY / "benchmarks" / "peers" / "README.md").read_text(encoding="utf-8")
    for name in MAKERS:
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{name}` |")]
        assert "Apache-2.0" in row


def before_activations() -> Peer:
    """thermosplat as a renderer that is given what Faster-GS is, and returns colours alone."""

    def renderer(case: str, t: Tensors, width: int, height: int) -> object:
        def render() -> Rendered:
            image, _, _ = rasterization(
                t["means"], t["quats"], t["log_scales"].exp(), t["logit_opacities"][:, 0].sigmoid(),
                torch.cat([t["sh0"], t["shN"]], 1), t["viewmats"], t["Ks"], width, height, sh_degree=3,
            )  # fmt: skip
            return Rendered([image], [])

        return render

    raw = RawParameters(raw_leaves, gradients_of_activated)
    return Peer("raw", "thermosplat", renderer, cases=("rgb",), raw=raw, num_images=1)


def test_a_peer_that_activates_its_parameters_is_compared_fairly() -> None:
    """Gradients after the chain rule, and colours without alphas, are thermosplat's own."""
    peers, device = [thermosplat_peer(), before_activations()], torch.device("cpu")
    row = run_case(synthetic_scene(60), "rgb", SIZE, device, peers, 1, with_truth=True, peaks=None)
    assert not row["apart"]
    assert not row["left_out"]
    assert row["difference"]["raw"]["image_max"] < 1e-5
    assert max(value for name, value in row["difference"]["raw"].items() if name.startswith("grad_")) < 1e-3
    assert row["forward_backward"]["raw"]["median_ms"] > 0


def test_a_peer_with_other_gradients_is_marked() -> None:
    """Without the chain rule they are not those of the parameters."""

    def as_they_are(t: Tensors, found: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
        return (*found[:3], found[3][:, 0], torch.cat(found[4:], 1))

    wrong = replace(before_activations(), raw=RawParameters(raw_leaves, as_they_are))
    peers, device = [thermosplat_peer(), wrong], torch.device("cpu")
    row = run_case(synthetic_scene(60), "rgb", SIZE, device, peers, 1, with_truth=False, peaks=None)
    assert "gradients differ" in row["apart"]["raw"]
    assert "grad_scales" in row["apart"]["raw"]


def test_the_camera_of_faster_gs() -> None:
    """Names, and the camera's place."""
    t = inputs_of(synthetic_scene(5), "rgb", *SIZE, torch.device("cpu"))
    settings = settings_of(t, *SIZE)
    assert (settings["width"], settings["height"], settings["active_sh_bases"]) == (*SIZE, 16)
    place = torch.cat([settings["cam_position"], torch.ones(1)])  # type: ignore[list-item]
    torch.testing.assert_close(t["viewmats"][0] @ place, torch.tensor([0.0, 0.0, 0.0, 1.0]), atol=1e-5, rtol=0)
    assert settings["center_x"] == pytest.approx(t["Ks"][0, 0, 2].item())


def test_gsplats_main_branch_comes_from_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder's gsplat is used, in no process that has another one; here it is thermosplat's functions."""
    package = tmp_path / "gsplat"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from thermosplat import rasterization, spherical_harmonics\n__version__ = '1.6.0'\n", encoding="utf-8"
    )
    monkeypatch.setenv(gsplat_main.FOLDER, str(tmp_path))
    monkeypatch.setitem(sys.modules, "gsplat", ModuleType("gsplat"))
    with pytest.raises(ImportError, match="another gsplat is imported already"):
        gsplat_main.gsplat_main_peer()
    monkeypatch.delitem(sys.modules, "gsplat")
    peer = gsplat_main.gsplat_main_peer()
    monkeypatch.delitem(sys.modules, "gsplat")
    assert (peer.name, peer.tolerance) == ("gsplat-main", OTHER_CONVENTIONS)
    assert "1.6.0" in peer.description
    for case in ("rgb", "rgbt"):
        row = run_case(
            synthetic_scene(40), case, SIZE, torch.device("cpu"), [thermosplat_peer(), peer], 1,
            with_truth=False, peaks=None,
        )  # fmt: skip
        assert not row["apart"]
        assert not row["left_out"]


def test_directions_of_the_main_branch() -> None:
    """Its function of cameras, asked for directions."""
    dirs, coeffs = torch.randn(7, 3), torch.randn(7, 16, 3)
    found = gsplat_main.towards(spherical_harmonics)(3, dirs, coeffs)
    torch.testing.assert_close(found, spherical_harmonics(3, dirs, coeffs))


def test_two_gsplats_are_measured_in_two_processes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The second process has gsplat-main alone, and files of its own; a failure of either is one of both."""
    calls: list[list[str]] = []

    class Done:
        returncode = 0

    def ran(words: list[str], **_: object) -> Done:
        calls.append(words[2:])
        done = Done()
        done.returncode = len(calls) - 1
        return done

    monkeypatch.setattr(bench_rasterization.subprocess, "run", ran)
    report = str(tmp_path / "report.json")
    words = ["--device", "cpu", "--json", report, "--peers", "gsplat", "gsplat-main", "gswarp"]
    monkeypatch.setattr(sys, "argv", ["bench_rasterization.py", *words])
    assert bench_rasterization.main() == 1
    assert calls[0] == [*words, "--peers", "gsplat", "gswarp"]
    other = str(tmp_path / "report-gsplat-main.json")
    assert calls[1] == [*words, "--peers", "gsplat-main", "--json", other]
