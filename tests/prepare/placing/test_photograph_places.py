"""Places of thermal images without GPS: a path past the photographs."""

from dataclasses import replace

import numpy as np

from night_flight import night_flight
from thermosplat.prepare.placing.photograph_places import WIDTH, agreements, spacing
from thermosplat.prepare.registration.edge_correlation import edge_field


def test_images_lie_on_a_path_past_the_photographs() -> None:
    """Within one spacing of photographs, and a wrong focal length has a path that is much worse."""
    night = night_flight()
    fields = [edge_field(image.slopes, working_width=WIDTH) for image in night.images]
    path = agreements(night.photographs, fields, night.lens, (0.0,), edges_of=3).path()
    off = [np.linalg.norm((pose.centre - true.centre)[:2]) for pose, true in zip(path.moved, night.poses)]
    assert sum(np.array(off) < spacing(night.photographs.poses)) >= 12
    wrong = replace(night.lens, lens=night.lens.lens * [1.6, 1, 1, 1, 1])
    assert agreements(night.photographs, fields, wrong, (0.0,), edges_of=3).path().score < 0.8 * path.score
