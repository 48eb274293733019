"""LPIPS: numbers against an independent computation with random backbones, and where weights are looked for."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import thermosplat.image_quality.lpips
from thermosplat.errors import UserError
from thermosplat.image_quality.lpips import Lpips, find_lpips

VGG_PLAN = [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M"]


def alexnet_features() -> nn.Sequential:
    """AlexNet's convolutional part, layer by layer as torchvision numbers it."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2),
    )  # fmt: skip


def vgg16_features() -> nn.Sequential:
    """VGG16's convolutional part, layer by layer as torchvision numbers it."""
    layers: list[nn.Module] = []
    channels = 3
    for entry in VGG_PLAN:
        if entry == "M":
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(channels, int(entry), 3, padding=1), nn.ReLU()]
            channels = int(entry)
    return nn.Sequential(*layers)


NETS = {"alex": (alexnet_features, (1, 4, 7, 9, 11)), "vgg": (vgg16_features, (3, 8, 15, 22, 29))}


def backbone(net: str) -> dict[str, torch.Tensor]:
    """Random weights under torchvision's names."""
    torch.manual_seed(0)
    return {f"features.{name}": value for name, value in NETS[net][0]().state_dict().items()}


def images() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(4)
    target = torch.rand(40, 48, 3, generator=generator)
    return (target + 0.2 * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


def direct_lpips(net: str, render: torch.Tensor, target: torch.Tensor, normalize: bool) -> float:
    """The published definition in numpy, on activations of the layer-by-layer network."""
    features, taps = NETS[net][0](), NETS[net][1]
    features.load_state_dict({name.removeprefix("features."): value for name, value in backbone(net).items()})
    heads = torch.load(
        Path(thermosplat.image_quality.lpips.__file__).parent / "lpips_heads" / f"{net}.pth",
        map_location="cpu",
        weights_only=True,
    )

    def activations(image: torch.Tensor) -> list[np.ndarray]:
        x = (image * 2 - 1 if normalize else image).permute(2, 0, 1)[None]
        mean, std = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = (x - mean[None, :, None, None]) / std[None, :, None, None]
        kept = []
        for index, layer in enumerate(features[: taps[-1] + 1]):
            x = layer(x)
            if index in taps:
                kept.append(x[0].detach().double().numpy())
        return kept

    total = 0.0
    for layer, (a, b) in enumerate(zip(activations(render), activations(target))):
        a, b = (x / (np.sqrt((x * x).sum(0)) + 1e-10) for x in (a, b))
        weights = heads[f"lin{layer}.model.1.weight"].double().numpy()[0, :, 0, 0]
        total += float(np.einsum("chw,c->hw", (a - b) ** 2, weights).mean())
    return total


@pytest.mark.parametrize("net", ["alex", "vgg"])
@pytest.mark.parametrize("normalize", [True, False])
def test_against_the_definition(net: str, normalize: bool) -> None:
    """Both backbones and both input scalings equal the layer-by-layer computation."""
    render, target = images()
    metric = Lpips(backbone(net), normalize=normalize)
    expected = direct_lpips(net, render, target, normalize)
    assert expected > 1e-4
    assert metric(render, target) == pytest.approx(expected, rel=1e-4)
    assert ("[-1, 1]" if normalize else "[0, 1]") in metric.name


def test_equal_images_and_one_channel() -> None:
    """Equal images are at distance 0; one channel counts as grey."""
    render, target = images()
    metric = Lpips(backbone("alex"))
    assert metric(target, target) == 0.0
    grey = [image[..., :1] for image in (render, target)]
    assert metric(*grey) == pytest.approx(metric(*(image.expand(-1, -1, 3) for image in grey)), rel=1e-6)


@pytest.mark.parametrize(("net", "smallest"), [("alex", 31), ("vgg", 16)])
def test_too_small_images_have_no_lpips(net: str, smallest: int) -> None:
    """The smallest side that the backbone can process works, one pixel less gives None."""
    metric = Lpips(backbone(net))
    image = torch.rand(smallest, smallest, 3)
    assert metric(image, image) == 0.0
    assert metric(image[1:], image[1:]) is None


def test_weights_from_torchs_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What torchvision has downloaded is found without being named; AlexNet before VGG16."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    metric, reason = find_lpips(None)
    assert metric is None
    assert reason.startswith("LPIPS skipped")
    assert "--lpips-weights" in reason
    (tmp_path / "checkpoints").mkdir()
    for net, name in (("vgg", "vgg16-397923af.pth"), ("alex", "alexnet-owt-7be5be79.pth")):
        torch.save(backbone(net), tmp_path / "checkpoints" / name)
        metric, name_of_metric = find_lpips(None)
        assert metric is not None
        assert ("VGG16" if net == "vgg" else "AlexNet") in name_of_metric


def test_weights_from_a_file_or_folder(tmp_path: Path) -> None:
    """--lpips-weights names a file of any name, or a folder with torchvision's names."""
    state = backbone("alex") | {"classifier.1.weight": torch.zeros(2, 2)}  # torchvision's files hold the classifier too
    torch.save(state, tmp_path / "mine.pt")
    torch.save(state, tmp_path / "alexnet-owt-7be5be79.pth")
    render, target = images()
    distances = [find_lpips(path)[0](render, target) for path in (tmp_path / "mine.pt", tmp_path)]
    assert distances[0] == distances[1] == Lpips(state)(render, target)


def test_unusable_weights_are_users_errors(tmp_path: Path) -> None:
    """A path that was given must work: missing, empty, not torch's, not a backbone."""
    with pytest.raises(UserError, match="does not exist"):
        find_lpips(tmp_path / "missing.pth")
    with pytest.raises(UserError, match="has none"):
        find_lpips(tmp_path)
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(UserError, match="cannot be read as PyTorch weights"):
        find_lpips(tmp_path / "text.pth")
    torch.save({"features.conv0.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(UserError, match="neither torchvision's AlexNet nor its VGG16"):
        find_lpips(tmp_path / "other.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(UserError, match="not a state dict"):
        find_lpips(tmp_path / "list.pth")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda state: {7: torch.zeros(3)}, "neither torchvision's AlexNet nor"),
        (lambda state: state | {7: "seven"}, None),
        (lambda state: state | {"features.3.weight": [1.0]}, r"features\.3\.weight .* holds no tensor"),
        (lambda state: state | {"features.3.weight": torch.zeros(192, 64, 3, 3)}, r"shape \[192, 64, 3, 3\]"),
        (lambda state: state | {"features.3.bias": torch.zeros(191)}, r"expected are numbers of shape \[192\]"),
        (
            lambda state: {key: value for key, value in state.items() if "bias" not in key},
            r"0\.bias .* holds no tensor",
        ),
        (lambda state: state | {"features.0.bias": torch.full((64,), torch.nan)}, "no finite number"),
        (lambda state: state | {"features.0.bias": torch.zeros(64, dtype=torch.int64)}, "no finite number"),
        (lambda state: state | {"features.0.bias": torch.zeros(64).to_sparse()}, "sparse"),
    ],
)
def test_weights_of_another_shape(tmp_path, change, says):
    """Dictionaries that are not quite a backbone are told by the entry that is wrong."""
    torch.save(change(backbone("alex")), tmp_path / "alexnet.pth")
    if says is None:
        assert find_lpips(tmp_path / "alexnet.pth")[0] is not None
        return
    with pytest.raises(UserError, match=says):
        find_lpips(tmp_path / "alexnet.pth")
