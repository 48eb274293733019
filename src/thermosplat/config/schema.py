"""What a run can be told: frozen dataclasses are the schema, YAML presets fill it, flags override.

This file imports nothing heavy, so that ``thermosplat-train --help`` answers at once. Every number states its source:
"3DGS" is Kerbl et al. 2023 as its reference code and gsplat 1.5.3's trainer set it; "ThermoSplat" is Su et al., the
method this package implements; "open choice" marks what that paper leaves open.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

from thermosplat.spectra import DEFAULT_SPECTRA, SpectrumConfig

Refined = Literal["poses", "placed", "rig", "intrinsics", "distortion"]
OF_FRAMES: frozenset[Refined] = frozenset({"poses", "placed"})
"""What of the cameras each frame has of its own."""
LensUse = Literal["undistort", "direct"]
ImageSize = Literal["auto"] | int
Steps = int | float
"""Of a schedule: a whole number counts steps of one frame, a number with a point is that share of the run."""


@dataclass(frozen=True)
class DecoderConfig:
    """The pixel-wise networks between rendered features and images (ThermoSplat, section on feature modulation)."""

    hidden_dim: int = 64
    """Width of the shared encoder and of the prior heads. Open choice: MS-Splatting 16 to 32, FeatSplat 64."""
    modulation: bool = True
    """Feature-wise modulation of one spectrum by another one's prior. Off: plain heads (ablation "MLP-based")."""
    branches: Literal["joined", "separate"] = "joined"
    """One network whose first layers all spectra share (ThermoSplat), or a plain one per spectrum, which have nothing
    in common but their input (MS-Splatting); those have no modulation."""
    view_direction: bool = False
    """The decoders also see the direction in which a pixel looks. MS-Splatting."""
    fourier_frequency: float = 0.0
    """ω: the decoders also see sin(ω f) and cos(ω f) of the rendered features f. Tancik et al. 2020; of what Gaussians
    blend, Neural Harmonic Textures. 0: features alone, as ThermoSplat. Open choice: 3."""
    hybrid: bool = True
    """A photograph that comes first in the list of spectra is the SH render plus the decoded part. Off: the decoded
    part alone (ablation "w/o hybrid RGB")."""
    padding: float = 0.0
    """How far beyond 0 and 1 images that are decoded alone may reach. At 0 logits sink without end where images are 0,
    and what they take along comes back slowly, since the sigmoid has no slope there. Mip-NeRF has 0.001. Open choice
    for short trainings: 0.1; benchmarks/records/cpu.md."""


@dataclass(frozen=True)
class ModelConfig:
    """What a Gaussian holds and which Gaussians there are."""

    gaussian_sets: Literal["shared", "separate"] = "shared"
    """One set of Gaussians for all spectra, or one set each, trained alone (the "3DGS" rows of the paper's table)."""
    feature_dim: int = 8
    """Latent channels d per Gaussian, decoded per pixel. 0: none, each spectrum is rendered from its SH colours; a
    shared set then holds those of every spectrum (ThermalGaussian OMMG, MMOne)."""
    eps2d: float = 0.3
    """Added to the variances of a Gaussian's footprint along both axes of the image [px²]: 0.3 blurs by a deviation of
    0.55 px. 3DGS and gsplat."""
    init_opacity: float = 0.1
    """Opacity of the first Gaussians. 3DGS."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms that are not one spectrum's (ThermoSplat; method equations 9 to 13)."""

    ssim_lambda: float = 0.2
    """λ_s: share of 1 - SSIM in every image loss; the rest is L1. ThermoSplat, 3DGS."""
    features: float = 1.0
    """λ_rf: weight of the loss on rendered features. ThermoSplat. Without features it has no effect."""
    feature_norm: float = 0.0
    """Weight of the mean of (|f| - 1)² over the Gaussians. MS-Splatting: 0.1."""
    opacity_reg: float = 0.0
    """Weight of the mean opacity, of every opacity that the Gaussians have. 3DGS-MCMC: 0.01."""
    scale_reg: float = 0.0
    """Weight of the mean scale, in units of the scene's extent. 3DGS-MCMC: 0.01."""
    depth_spread: float = 0.0
    """Weight of the spread of log-depth along rays, of every spectrum, in the second half of the run. 2DGS's depth
    distortion, with squares."""
    balance: bool = False
    """Multiply the losses of a separate set by the other sets' share of all Gaussians. ThermalGaussian MSMG."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam's learning rates of the scene, each a constant unless it or ``final_share`` says otherwise."""

    means_lr: float = 1.6e-4
    """Means, times the scene's extent. 3DGS."""
    means_lr_final: float = 1.6e-6
    """Means at the last step (exponential decay), times the scene's extent. 3DGS."""
    scales_lr: float = 5e-3
    """Log-scales. 3DGS."""
    quats_lr: float = 1e-3
    """Quaternions. 3DGS."""
    opacities_lr: float = 5e-2
    """Logit-opacities, and offsets and own logits of the opacities of further spectra. 3DGS (gsplat and the original
    code: 0.05); MMOne trains its thermal opacity with the same rate."""
    sh0_lr: float = 2.5e-3
    """SH degree 0, of every spectrum that has SH colours. 3DGS."""
    shN_lr: float = 2.5e-3 / 20
    """SH degrees 1 and above, of every spectrum that has SH colours. 3DGS."""
    shN_decay: float = 0.0
    """Decay of SH degrees 1 and above: each step they lose this times their rate of themselves (AdamW, Loshchilov &
    Hutter 2019). What the images do not ask for becomes zero, so that ``--budget auto`` stores fewer of them. Open
    choice: 4; benchmarks/records/thermosplat-plus-preset.md."""
    features_lr: float = 5e-3
    """Latent features. Open choice: MS-Splatting's."""
    features_lr_final: float = 5e-4
    """Latent features at the last step (exponential decay). Open choice: as the decoders'; at a constant rate features
    go on fitting the noise of the training views (benchmarks/records/thermosplat-preset.md)."""
    decoders_lr: float = 5e-3
    """Decoder networks. Open choice: MS-Splatting's."""
    decoders_lr_final: float = 5e-4
    """Decoder networks at the last step (exponential decay). Open choice."""
    final_share: float = 1.0
    """Share of every other rate that is left at the last step (exponential decay). 3DGS: 1, all of it."""
    cooldown_from: float = 1.0
    """Share of the steps after which every rate also falls to zero, in a straight line. 1: none does. Open choice;
    Hägele et al. 2024, "Scaling Laws and Compute-Optimal Training Beyond Fixed Training Durations"."""


SPLIT_APART_MOST = 0.8
"""Largest ``densification.split_apart``: from 0.86 on, a clear Gaussian would become two of opacities above 1."""


@dataclass(frozen=True)
class DensificationConfig:
    """When Gaussians are cloned, split, pruned and reset (3DGS's adaptive density control), or relocated (MCMC)."""

    strategy: Literal["default", "mcmc", "decomposing"] = "default"
    """"default": 3DGS's adaptive density control. "mcmc": 3DGS-MCMC (Kheradmand et al. 2024). Gaussians that every
    spectrum sees fainter than ``prune_opacity`` move onto others, their number grows by ``growth`` up to
    ``max_gaussians``, and noise moves faint ones. It needs no thresholds and no resets; its opacities are held down by
    ``loss.opacity_reg``. "decomposing": as default, and Gaussians that two spectra pull apart become one of each
    spectrum (MMOne)."""
    growth: float = 0.05
    """MCMC: share of the Gaussians that a refinement adds. 3DGS-MCMC."""
    position_noise: float = 5e5
    """MCMC: standard deviation of the noise on the means, times their learning rate and covariance, in scene extents.
    3DGS-MCMC, there in the capture's own units."""
    sample_by: Literal["opacity", "gradient", "both"] = "opacity"
    """MCMC: Gaussians are doubled with a probability proportional to their larger opacity (3DGS-MCMC), or to the mean
    gradient of means2d, of all spectra, that the default strategy compares with its threshold (open choice), or half of
    them by the one and half by the other."""
    split_apart: float = 0.0
    """MCMC: the two that a Gaussian becomes lie so far to either side of it along its longest axis, in its standard
    deviations there, and are narrower by as much. 0: both in its place, as in 3DGS-MCMC. At most 0.8. Open choice;
    splits along the longest axis: ImprovedGS (Deng et al. 2025)."""
    start_step: Steps = 0.01667
    """The count changes after this step, or share of the run, only: at the first multiple of ``every`` above it. 3DGS:
    500 of 30,000."""
    stop_step: Steps = 0.5
    """No growth from this step, or share of the run, on. 0: the number of Gaussians stays what it is. 3DGS: 15,000."""
    every: Steps = 0.00333
    """Steps, or share of the run, between refinements. 3DGS: 100."""
    grad_threshold: float = 4e-4
    """Mean norm of the means2d gradient, in units of half the image, above which a Gaussian grows. 3DGS: 2e-4 for one
    image loss. In a shared set the gradients of both passes are summed (open choice: MMOne adds them as vectors), and
    the loss sums two terms on the RGB image (render and features) where 3DGS has one: twice the gradient, so twice the
    threshold. Open choice; with 2e-4 the same views get several times 3DGS's Gaussians."""
    absgrad: bool = False
    """Use the sum of absolute per-pixel gradients (AbsGS); its usual threshold is 8e-4."""
    prune_opacity: float = 0.005
    """Gaussians fainter than this go; with several opacities all must be. 3DGS (open choice: the maximum). A reset
    leaves no opacity above twice this."""
    reset_every: Steps = 0.1
    """Steps, or share of the run, between opacity resets, of every spectrum. After the first of them Gaussians that are
    too large go, too. 3DGS: 3000 (open choice: MMOne resets both)."""
    max_gaussians: int | None = None
    """Growth stops at this count; of several ``scenes`` each has its part of it. None: no limit, as in 3DGS. The MCMC
    strategy needs one: with None it is one Gaussian for each pixel of the largest training image, from 300,000 to 3
    million (open choice; gsplat has a million). With noisy images it may be 150,000."""


@dataclass(frozen=True)
class ResolutionConfig:
    """Early steps on smaller images, which take less time and show what there is to learn first (DashGaussian, Chen et
    al. 2025). Off in thermosplat. Evaluation, validation views and the search for cameras have images of full size."""

    factors: tuple[float, ...] = ()
    """The sides of training images are divided by these, one after the other, before steps at full size. No side
    becomes shorter than 32 pixels. Open choice; DashGaussian chooses by the images' frequencies."""
    until: tuple[float, ...] = ()
    """For each of the factors the share of the run after which it ends."""
    growth_power: float = 1.0
    """While sides are divided by f, Gaussians are added up to ``densification.max_gaussians`` / f to this power. 2: as
    many to a pixel as at the end; 0: the limit is always the same. DashGaussian: from 2 in the first step to 1."""


@dataclass(frozen=True)
class AutoBudgetConfig:
    """How ``--budget auto`` finds the size of the model; without it nothing of this happens. What it may change is
    constant (training/budget/tolerances.py)."""

    prune_at: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8)
    """Shares of the run after which the Gaussians that matter least are removed, where growth has ended; it ends with
    the last. Several small cuts with training between them take away more than one, as what is left makes up for what
    is gone (open choice); the last leaves a fifth of the run to do so."""
    validate_every: Steps = 0.00833
    """Steps, or share of the run, between looks at the validation views: growth stops twelve looks after their PSNR has
    last risen."""


@dataclass(frozen=True)
class TrainConfig:
    """Train 3D Gaussians of several spectra on a capture and evaluate them on its held-out views."""

    data: str = ""
    """Folder of the capture, or "sample" for the small one that comes with the package."""
    config: str = "thermosplat"
    """Preset (thermosplat, thermosplat_plus, thermosplat_fast, demo, 3dgs, another baseline's or an ablation's name) or
    YAML file that the other values start from."""
    result_dir: str | None = None
    """Where everything the run makes goes. None: results/<capture's name>/<config's name>."""
    max_steps: int = 30_000
    """Training steps, one frame (all its spectra) each. Schedules are shares of them, unless they are given in steps,
    as whole numbers. ThermoSplat, 3DGS."""
    steps_scaler: float = 1.0
    """What all numbers of steps are multiplied by, ``max_steps`` and those that schedules are given in: with 0.5 a
    training has the same course in half of the steps. Only what finds cameras before the scene (``refine_first``), the
    rounds of ``refine`` and ``log_every`` stay. gsplat."""
    steps_for_views: int | None = None
    """Training views that these numbers of steps are meant for. With more, all of them are multiplied as by
    ``steps_scaler``, so that each view is seen as often, up to 30,000 of each scene. None: whatever the views. A file
    or command that gives ``max_steps`` and not this means None. Open choice."""
    noisy_steps: float = 1.0
    """What all numbers of steps are multiplied by in the same way, with ``--budget auto``, where images of a spectrum
    are noisy. A file or command that gives ``max_steps`` and not this means 1. Open
    choice; benchmarks/records/low-light.md."""
    scenes: int = 1
    """Scenes that are trained one after the other, from the same points with other random numbers, each up to
    ``optimizer.cooldown_from``. There they become one, with the Gaussians of all, which takes the steps that are left.
    What differs between them by chance is averaged. Open choice; benchmarks/records/thermosplat-plus-preset.md."""
    batch_size: int | None = None
    """Frames of a step, whatever the number of devices. None: one for each device. All numbers of steps here are for
    steps of one frame and are divided by it, so that as many images are seen; learning rates are multiplied by its
    square root (docs/several-devices.md). Grendel (Zhao et al. 2024)."""
    data_factor: int = 1
    """Divide the images' width and height by this."""
    image_size: ImageSize = "auto"
    """Longest side of the images [px]; larger ones are shrunk, of each spectrum by itself. auto: 1600, unless
    ``data_factor`` is given, as the code of 3DGS has it."""
    lens: LensUse = "undistort"
    """What is done about distorted lenses: "undistort" resamples their images to pinhole images; "direct" leaves images
    as they were taken, for training and evaluation, and renders through the lens."""
    image_memory: float | None = None
    """Most of the host's memory that images take [GB]. The images of a capture that needs more stay on the disk; other
    processes read them while steps run, and what was undistorted is kept in the result folder until the training ends
    (docs/scaling.md). Numbers do not depend on it. None: half of the memory there is. Open choice."""
    test_every: int = 8
    """Every n-th frame is held out, unless the capture's folders say which are. 3DGS, RGBT-Scenes."""
    sh_degree: int = 3
    """Highest degree of the spherical harmonics, 0 to 4. 3DGS (3)."""
    sh_degree_interval: Steps = 0.03333
    """Steps, or share of the run, after which one more SH degree is used. 3DGS: 1000 of 30,000."""
    device: str = "auto"
    """"cuda", "cuda:1", "cpu", or "auto": CUDA where there is a device."""
    offload: Literal["auto", "on", "moments", "off"] = "auto"
    """Keep spherical harmonics above degree 0, latent features and what Adam knows of them ("on"), or the latter alone
    ("moments"), in the host's memory. A step fetches and updates those of the Gaussians in view; Adam leaves those of
    others as they are (docs/scaling.md). "auto": on CUDA, no more than is needed for the Gaussians to fit on the
    device."""
    gpu_memory: float | None = None
    """Most of the GPU's memory that the training takes [GB]. None: all that is free."""
    graph: bool = True
    """On CUDA, record the work of a step once and replay it as a CUDA graph (--no-graph: launch it line by line)."""
    compile: bool = True
    """On CUDA, decode by fused kernels, or where there are none for the decoders, their precision or the device let
    torch.compile fuse them (half a minute at the first step, kept for later runs; left out where Triton or a C compiler
    is missing). --no-compile: plain PyTorch."""
    decoder_precision: Literal["float32", "tf32"] = "tf32"
    """Precision of the decoders in training steps; parameters and evaluation are always float32. With "tf32" matrix
    products round their inputs to 10 bits of mantissa (TensorFloat-32, or float16 in the fused kernels); on the CPU it
    is float32."""
    seed: int = 42
    """Seed of everything random. gsplat."""
    deterministic: bool = False
    """On CUDA, train to the same bits every time on one machine: gradients are summed in a fixed order, at a cost in
    time and memory that benchmarks/bench_training.py measures. On the CPU that is always so."""
    eval_steps: tuple[int, ...] = (7_000, 30_000)
    """Steps at which the held-out views are evaluated; the last step always is. 3DGS."""
    save_steps: tuple[int, ...] = (7_000, 30_000)
    """Steps at which a checkpoint is written; the last step always is. 3DGS."""
    log_every: int = 100
    """Steps between lines of metrics.jsonl (and of the console, where it is not a terminal)."""
    tensorboard: bool = True
    """Write TensorBoard event files where tensorboard is installed."""
    lpips_weights: str | None = None
    """Folder or file with LPIPS backbone weights (torchvision state_dict) for the LPIPS columns. None: torchvision's
    cache; LPIPS is null where there is none."""
    budget: Literal["fixed", "auto"] = "fixed"
    """"auto" finds the number of Gaussians, opacity offsets and SH bands that the training views support (the
    auto_budget settings) and leaves the rest out; "fixed" is what the densification settings give."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the SH render of a photograph, 0 to 1. 3DGS: black."""
    resume: str | None = None
    """Result folder of an interrupted run to go on with."""
    overwrite: bool = False
    """Delete what an earlier run left in the result folder."""
    refine: tuple[Refined, ...] = ()
    """What of the cameras is corrected while training: the "poses" of the frames; "placed", those of the frames alone
    that have no image of the first spectrum; the "rig", how the cameras of the spectra stand to the first one;
    "intrinsics", the focal lengths of these cameras, or of the only spectrum's; "distortion", what undistorting the
    images has left, or with --lens direct the lens itself. Held-out frames take over what all have in common; their
    poses are found on the finished scene. "intrinsics" goes with --lens direct: images that were undistorted with a
    wrong focal length stay wrong towards the corners."""
    refine_from: Steps = 0.01667
    """Steps, or share of the run, before poses, and the first spectrum's camera, are corrected: as long as there is no
    scene, images say little of them. Open choice."""
    refine_every: int = 8
    """Steps between two rounds that register the cameras of the other spectra to the scene (rig, focal lengths,
    distortion). Open choice."""
    refine_first: int = 600
    """Where rig, focal lengths or distortion are corrected: two passes of so many steps come first, of ``max_steps`` if
    that is less. They find these cameras on a scene that the first spectrum alone shapes. Then it starts anew with
    them. 0: without passes. Open choice, measured (benchmarks/records/refinement.md): a pass then has 64 rounds."""
    refine_rounds_from: int = 84
    """Steps of such a pass before its first round: a scene that is too young may send a camera away. Open choice,
    measured: from 40 on, one of three trainings lost it; from 84 on, none (benchmarks/records/refinement.md)."""
    refine_rates: float = 6.0
    """What the learning rates of means, quaternions, scales and colours are multiplied by in these passes, which are
    short trainings. Open choice: the preset demo's rates are about as many times thermosplat's."""
    without: tuple[str, ...] = ()
    """Spectra that are left out: --without thermal trains on the others alone."""
    spectra: dict[str, SpectrumConfig] = field(default_factory=lambda: dict(DEFAULT_SPECTRA))
    model: ModelConfig = field(default_factory=ModelConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    densification: DensificationConfig = field(default_factory=DensificationConfig)
    resolution: ResolutionConfig = field(default_factory=ResolutionConfig)
    auto_budget: AutoBudgetConfig = field(default_factory=AutoBudgetConfig)

    @cached_property
    def modelled(self) -> dict[str, SpectrumConfig]:
        """The spectra that are trained and rendered, by name, in order."""
        return {name: spectrum for name, spectrum in self.spectra.items() if name not in self.without}
