"""What ``--budget auto`` may change, and how sure it must be: constants of the method, in one place.

A change of training images is measured as image_change.py does: their squared change as a share of their squared error,
in the spectrum where that is larger. A change of x would cost 10 log10(1 + x) dB of the training views' PSNR if no step
followed, 0.09 dB for 0.02. Held-out views have larger errors, so that the same change costs them less.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerances:
    """Open choices, measured in benchmarks/records/model-size.md and low-light.md."""

    prune_change: float = 0.02
    """Largest change by one removal of Gaussians, before anything is fine-tuned."""
    offset_shrinkage: float = 0.02
    """λ: soft threshold of opacity offsets after a step, as a multiple of their learning rate."""
    offset_change: float = 0.02
    """Largest change by the opacity offsets that become zero for good at the last pruning; the others shrink no
    further. Offsets are a hundredth of the model, so little is risked for them."""
    feature_change: float = 0.01
    """Largest change, also of channels that losses see, by the latent channels that go then."""
    sh_change: float = 0.01
    """Largest change by spherical harmonics that go at the end, untuned afterwards: 0.04 dB."""
    rounding_change: float = 0.002
    """Largest change by parameters that are rounded to float16 at the end: 0.01 dB."""
    measured_views: int = 12
    """Training views, spread over all, whose change is looked at: a bisection renders them ten times."""
    noise_floor: float = 1.0
    """A training view whose squared error in a spectrum is below this share of the variance of that spectrum's noise
    has no gradient in it in that step: what is left of its error is noise, which no other view has. 0: every view has
    one."""
    validation_views: int = 2
    """Training views that are not trained on while Gaussians are added, and that say when to stop. None where that
    would be over a tenth."""
    least_gain: float = 0.02
    """Rise of the validation views' PSNR [dB], mean over views and spectra, that justifies more Gaussians."""
    growth_looks: int = 12
    """Looks at the validation views without such a rise after which growth stops: as long as from one opacity reset to
    the next. Too many Gaussians cost time alone, since pruning follows; too few cannot be made good."""
    spectrum_looks: int = 4
    """So many looks ago a spectrum must have been best to be held there, if its images are noisy."""
    spectrum_loss: float = 0.05
    """Fall of the validation views' PSNR in one spectrum [dB] from which on it learns noise, if its images are noisy:
    it is held where it was best, and goes back to it at the last pruning if it is so far below then."""
    few_views_until: float = 0.33
    """Share of the run up to which the validation views stay withheld if they are more than a twentieth of a spectrum's
    views and no images are noisy, also where growth ends earlier. A scene may fit few views ever better and be ever
    worse, and they say so: without this rule arco's thermal images lost 0.75 dB."""
    fallen_views_until: float = 0.5
    """Share of the run up to which they stay withheld where a spectrum has fallen by then: it goes back only if it is
    as far below its best there, since a scene may be worse for a while."""
    spectrum_fall: float = 0.3
    """Fall of such a capture's validation views in one spectrum [dB] from which on it goes back to where it was best,
    whatever its noise: in all of the last ``spectrum_looks`` before they are released."""
    held_change: float = 0.02
    """A spectrum that went back is compared with what the scene showed when it was best. A view that differs from that
    by less than this change has no gradient in it: the other spectra alone shape the scene."""


TOLERANCES = Tolerances()
"""Those of every training."""
