"""Thermal light transport: paths that collect what surfaces emit.

Every surface is an emitter here, so sampling reflections alone is the better estimator. And Mitsuba's own ``path`` is
biased for these scenes: it samples emission textures through a map from texture coordinates to the surface, which a box
does not have.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rendered_captures.sensors.shutter import LineMotion


def emission_path(max_depth: int, ambient: float) -> Any:
    """An integrator, for the variant that was started.

    Args:
        max_depth: Surfaces of a path at most.
        ambient: Radiance that a longer path would see [W/m^2/sr].
    """

    class EmissionPath(mi.SamplingIntegrator):
        def __init__(self) -> None:
            super().__init__(mi.Properties())
            self.motion: LineMotion | None = None
            self.numbers: Any = None

        def move(self, motion: LineMotion | None) -> None:
            """How the camera moves while its lines are read, from the next render on."""
            self.motion = motion
            if motion is not None:
                self.numbers = mi.Float(np.concatenate([motion.velocity, motion.turn]))
                dr.make_opaque(self.numbers)

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            radiance, weight = mi.Spectrum(0.0), mi.Spectrum(1.0)
            active, valid, ray = mi.Bool(active), mi.Bool(False), mi.Ray3f(ray)
            if self.motion is not None:
                ray = _at_its_line(ray, scene.sensors()[0].world_transform(), self.motion, self.numbers)
            for bounce in range(max_depth):
                hit = scene.ray_intersect(ray, active)
                # A smooth normal past the silhouette: take the triangle's.
                away = hit.is_valid() & (dr.dot(hit.sh_frame.n, ray.d) * dr.dot(hit.n, ray.d) <= 0)
                hit.sh_frame = dr.select(away, mi.Frame3f(hit.n), hit.sh_frame)
                hit.wi = dr.select(away, hit.to_local(-ray.d), hit.wi)
                radiance += dr.select(active, weight * hit.emitter(scene, active).eval(hit, active), 0.0)
                if bounce == 0:
                    valid = active & hit.is_valid()
                active &= hit.is_valid()
                numbers = sampler.next_1d(active), sampler.next_2d(active)
                chosen, share = hit.bsdf(ray).sample(mi.BSDFContext(), hit, *numbers, active)
                weight = dr.select(active, weight * share, weight)
                stop = active & ((dr.max(weight) < 0.01) | (bounce == max_depth - 1))
                radiance += dr.select(stop, weight * ambient, 0.0)
                active &= ~stop
                ray = hit.spawn_ray(hit.to_world(chosen.wo))
            return radiance, valid, []

    return EmissionPath()


def _at_its_line(ray: Any, to_world: Any, motion: LineMotion, numbers: Any) -> Any:
    """The ray from where the camera is when the ray's line is read."""
    local = to_world.inverse() @ ray.d
    x, y = -local.x / local.z, -local.y / local.z
    squared = x * x + y * y
    line = motion.focal * y * (1 + motion.k1 * squared + motion.k2 * squared * squared) + motion.cy
    time = dr.clip(line / motion.height - 0.5, -0.6, 0.6)
    part = [dr.gather(mi.Float, numbers, mi.UInt32(k)) for k in range(6)]
    velocity, turn = mi.Vector3f(*part[:3]), mi.Vector3f(*part[3:])
    angle = dr.norm(turn)
    axis = dr.select(angle > 0, turn / dr.maximum(angle, 1e-12), mi.Vector3f(0, 0, 1))
    centre = to_world @ mi.Point3f(0, 0, 0)
    sine, cosine = dr.sincos(time * angle)

    def turned(vector: Any) -> Any:
        return vector * cosine + dr.cross(axis, vector) * sine + axis * dr.dot(axis, vector) * (1 - cosine)

    ray.o = centre + turned(ray.o - centre) + velocity * time
    ray.d = turned(ray.d)
    return ray
