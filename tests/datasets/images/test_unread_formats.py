"""Pictures in formats that are not read are named, with what converts them."""

from pathlib import Path

import pytest

from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.images.unread_formats import unread_note
from thermosplat.errors import UserError


def test_pictures_of_a_folder(tmp_path: Path) -> None:
    """They are counted whatever the case of their endings; files that are no pictures are not told of."""
    assert unread_note(tmp_path) is None
    for name in ("a.HEIC", "sub/b.heic", "c.avif", "d.jpg", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    assert unread_note(tmp_path) == (
        f"3 pictures of {tmp_path} are HEIC and AVIF, which is not read (first: a.HEIC). Convert them to JPEG or PNG, "
        f"such as: magick mogrify -format jpg {tmp_path}/*.HEIC"
    )
    (tmp_path / "0.dng").write_bytes(b"x")
    assert (unread_note(tmp_path) or "").endswith("Develop them into JPEG or TIFF files with a raw converter.")


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "HEIC"),
        (b"\0\0\0\x1cftypavif\0\0\0\0", "AVIF"),
        (b"GIF89a\x20\0\x18\0", "GIF"),
        (b"\0\0\0\x0cJXL \r\n\x87\n", "JPEG XL"),
        (b"\0\0\0\x0cjP  \r\n\x87\n", "JPEG 2000"),
        (b"8BPS\0\x01", "Photoshop"),
    ],
)
@pytest.mark.parametrize("suffix", [".jpg", ".heic"])
def test_content_that_is_another_format(tmp_path: Path, content: bytes, name: str, suffix: str) -> None:
    """Phones write HEIC under the names of JPEGs."""
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    with pytest.raises(UserError, match=rf"a\{suffix} is a picture of the format {name}, which is not read") as caught:
        read_image(path)
    assert f"magick mogrify -format jpg {tmp_path}/*{suffix}" in caught.value.hint
