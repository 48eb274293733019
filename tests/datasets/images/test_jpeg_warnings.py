"""JPEG files whose decoder fills what is missing are refused by name."""

import json
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture_folders import HEIGHT, WIDTH, write_transforms
from forked_processes import run_python
from thermosplat.datasets import load_capture
from thermosplat.datasets.images import jpeg_warnings
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.images.jpeg_warnings import check_jpegs, refusing_damage
from thermosplat.errors import UserError


def jpeg(number: int, *, progressive: bool = False) -> bytes:
    noise = np.random.default_rng(number).integers(0, 256, (200, 300, 3), np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, 92, cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)]
    return cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 1), options)[1].tobytes()


def zeroed(content: bytes, count: int) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes(count) + content[middle + count :]


def written(folder: Path, **files: bytes) -> list[Path]:
    paths = [folder / f"{name}.jpg" for name in files]
    for path, content in zip(paths, files.values()):
        path.write_bytes(content)
    return paths


@pytest.mark.parametrize("progressive", [False, True])
def test_zeroed_data_is_refused_by_name(tmp_path, capfd, progressive):
    """The picture is decoded nevertheless, so that pixels alone do not tell."""
    good, bad = written(tmp_path, good=jpeg(0), bad=zeroed(jpeg(1, progressive=progressive), 5000))
    assert read_image(bad).shape == (200, 300, 3)
    capfd.readouterr()
    with pytest.raises(UserError, match=r"bad\.jpg is damaged \(Corrupt JPEG data"):
        check_jpegs([good, bad])
    with pytest.raises(UserError, match=r"bad\.jpg"):  # not only the first time
        check_jpegs([good, bad])


@pytest.mark.parametrize(("count", "is_damage"), [(1, False), (16, False), (40, True), (400, True)])
def test_a_few_bytes_before_the_end_mark_are_no_damage(tmp_path, capfd, count, is_damage):
    """Phones write them; the picture is whole. Many are what is left of a picture that lost its place."""
    content = jpeg(0)
    (path,) = written(tmp_path, phone=content[:-2] + b"\x55" * count + content[-2:])
    with pytest.raises(UserError, match=r"phone\.jpg is damaged") if is_damage else nullcontext():
        check_jpegs([path])
    capfd.readouterr()


@pytest.mark.parametrize("spectrum", ["images", "thermal"])
def test_a_capture_with_a_damaged_jpeg(tmp_path, capfd, spectrum):
    """Any image of any spectrum; nothing is trained on what a decoder made up."""
    content = write_transforms(tmp_path)
    for number, frame in enumerate(content["frames"]):
        for key in ("file_path", "thermal_file_path"):
            frame[key] = frame[key].replace(".png", ".jpg")
            noise = np.random.default_rng(number).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
            (tmp_path / frame[key]).write_bytes(cv2.imencode(".jpg", noise)[1].tobytes())
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    assert len(load_capture(tmp_path).train) == 6
    path = tmp_path / spectrum / "frame_train_00003.jpg"
    path.write_bytes(zeroed(path.read_bytes(), 100))
    with pytest.raises(UserError, match=rf"{spectrum}/frame_train_00003\.jpg is damaged \(Corrupt JPEG data"):
        load_capture(tmp_path)
    capfd.readouterr()


def test_whole_files_are_looked_at_once(tmp_path, monkeypatch):
    """A file is looked at again when it has changed."""
    paths = written(tmp_path, a=jpeg(0), b=jpeg(1))
    check_jpegs(paths)
    monkeypatch.setattr(jpeg_warnings, "DECODER", tmp_path / "none.py")
    check_jpegs(paths)
    monkeypatch.undo()
    paths[1].write_bytes(zeroed(jpeg(1), 4000) + b"\xff\xd9")
    with pytest.raises(UserError, match=r"b\.jpg is damaged"):
        check_jpegs(paths)


def test_code_of_the_current_folder_is_not_run(tmp_path, monkeypatch):
    """A capture's folder may hold a file that is called like a module."""
    (tmp_path / "cv2.py").write_text("raise SystemExit(3)")
    (tmp_path / "struct.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    check_jpegs(written(tmp_path, a=jpeg(0)))


def test_a_decoder_that_ends_early_is_told(tmp_path, monkeypatch):
    """Files that were not looked at are not taken for whole ones."""
    paths = written(tmp_path, a=jpeg(0), b=jpeg(1))
    (tmp_path / "decoder.py").write_text("import os; os.write(2, bytes(2)); os._exit(7)")
    monkeypatch.setattr(jpeg_warnings, "DECODER", tmp_path / "decoder.py")
    with pytest.raises(UserError, match=r"b\.jpg ended the process .* \(exit code 7\)"):
        check_jpegs(paths)


DECODES_ALONE = """
import os, sys
from pathlib import Path
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.images.jpeg_warnings import decode_alone, refusing_damage
from thermosplat.errors import UserError
decode_alone()
good, bad = map(Path, sys.argv[1:])
with refusing_damage(good):
    read_image(good)
try:
    with refusing_damage(bad):
        read_image(bad)
except UserError as error:
    print(error.message)
os.write(2, b"heard")
"""


def test_a_process_that_decodes_alone_hears_its_decoder(tmp_path, capfd):
    """There a damaged file is refused while it is read; what else is written to the standard error comes through."""
    good, bad = written(tmp_path, good=jpeg(0), bad=zeroed(jpeg(1), 5000))
    done = run_python("-c", DECODES_ALONE, good, bad)
    assert f"{bad} is damaged (Corrupt JPEG data" in done.stdout
    assert done.stderr == "heard"
    with refusing_damage(bad):  # elsewhere nothing happens
        read_image(bad)
    assert "Corrupt JPEG data" in capfd.readouterr().err
