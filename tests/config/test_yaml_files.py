"""YAML files from strangers: plain values, in a bounded size, and messages that repeat no other file."""

from pathlib import Path

import pytest

from thermosplat.config.checks import check_config
from thermosplat.config.files import from_dict, load_config
from thermosplat.config.schema import TrainConfig
from thermosplat.config.values import fill
from thermosplat.errors import UserError


def refused(folder: Path, text: str | bytes, match: str) -> str:
    path = folder / "mine.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserError, match=match) as caught:
        load_config(path)
    assert len(str(caught.value)) < 1000
    return str(caught.value)


@pytest.mark.parametrize("value", ["${oc.env:HOME}", "a${seed}b", "${oc.env:NONE,else}", "[x, '${seed}']"])
def test_values_are_not_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    """The environment of whoever starts the command is not a stranger's to read."""
    monkeypatch.setenv("HOME", "/home/secret")
    message = refused(tmp_path, f"data: {value}\n", r"data is .*, and \$\{\.\.\.\} is not expanded")
    assert "secret" not in message


@pytest.mark.parametrize(
    "text", ["pass: 'a\n  b: c", "root:x:0:0\npass,secret\n\tx", "pass secret", "- pass\n- secret"]
)
@pytest.mark.parametrize("name", ["other.yaml", "passwd", "key.txt"])
def test_a_base_does_not_print_other_files(tmp_path: Path, text: str, name: str) -> None:
    """Only presets and YAML files are bases, and what cannot be read is not repeated."""
    (tmp_path / name).write_text(text)
    message = refused(tmp_path, f"base: {tmp_path / name}\n", "other.yaml|neither a preset nor a YAML file")
    assert "secret" not in message
    assert "pass" not in message


def test_aliases_are_refused(tmp_path: Path) -> None:
    """Nine lines of aliases unpack to a billion values."""
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    for before, name in zip("abcdefgh", "bcdefghi"):
        lines.append(f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]")
    refused(tmp_path, "\n".join(lines), r"Line 2 of .* has a YAML alias")


@pytest.mark.parametrize(
    "text",
    [
        "a: " + "[" * 5000 + "]" * 5000,
        "".join(f"{'  ' * level}a:\n" for level in range(400)),
        "{a: " * 3000 + "}" * 3000,
    ],
)
def test_deep_nesting_is_refused(tmp_path: Path, text: str) -> None:
    """Before anything is built."""
    refused(tmp_path, text, "nested more than 16 levels deep")


def test_large_files_are_refused(tmp_path: Path) -> None:
    """A configuration has some thousand bytes."""
    refused(tmp_path, "a: 1\n" * 100_000, "has more than 262,144 bytes")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (f"seed: {'9' * 5001}\n", "cannot be read as YAML"),
        (f"seed: {'9' * 400}\n", '"seed" must be a whole number, found 999'),
        (f"seed: 0x{'9' * 5001}\n", '"seed" must be a whole number, found a int that is too long'),
        (f"init: {'9' * 400}\n", "unknown key"),
        (f"model:\n  eps2d: {'9' * 400}\n", '"model.eps2d" must be a number, found 999'),
        (f"{'x' * 1000}: 1\n", r'unknown key "x+\.\.\."'),
        (f"config: {'x' * 5000}\nseed: {'x' * 5000}\n", "found 'x+\\.\\.\\.\\."),
        (f"base: {'x' * 5000}\n", "neither a preset nor a YAML file"),
        (f"base: {'x' * 5000}.yaml\n", "There is no configuration file"),
        ("base: ''\n", "neither a preset"),
        (b"\xff\xfe\x00", "it is not UTF-8"),
        ("decoder:\n  hidden_dim: 100000\n", "decoder.hidden_dim must be at most 65536"),
        ("max_steps: 9223372036854775808\n", '"max_steps" must be a whole number'),
    ],
)
def test_values_of_any_length(tmp_path: Path, text: str | bytes, match: str) -> None:
    """Messages show the begin of a long value."""
    refused(tmp_path, text, match)


def test_a_deep_dictionary_is_refused() -> None:
    """As a checkpoint may hold one."""
    values: dict[str, object] = {}
    inner = values
    for _ in range(100_000):
        inner["model"] = {}
        inner = inner["model"]  # type: ignore[assignment]
    with pytest.raises(UserError, match="nested too deeply"):
        from_dict(values)


def test_flags_have_bounds() -> None:
    """100,000 channels are refused before the first is built, and so are steps without an end."""
    with pytest.raises(UserError, match=r"--decoder\.hidden-dim must be at most 65536, found 100000"):
        check_config(fill(TrainConfig(), {"decoder": {"hidden_dim": 100_000}}, source=""))
    with pytest.raises(UserError, match=r"--max-steps must be at most 100000000, found 1000"):
        check_config(TrainConfig(max_steps=10**400))
