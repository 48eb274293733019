"""m"""

import numpy as np


class Renderer:
    """One loaded scene, re-rendered from many poses without recompiling kernels."""

    def __init__(self, scene, W, H):
        self.scene, self.W, self.H = scene, W, H
        self.params = mi.traverse(scene)
        self.key = [k for k in self.params.keys() if k.endswith("sensor.to_world") or k == "sensor.to_world"][0]

    def pose(self, c2w):
        self.params[self.key] = mi.Transform4f(c2w)
        self.params.update()

    def image(self, c2w, spp, seed):
        self.pose(c2w)
        return np.array(mi.render(self.scene, spp=spp, seed=seed))[..., :3].astype(np.float32)

    def first_hit(self, c2w):
        """(z-depth, shape id) through pixel centres; depth 0 where nothing is hit."""
        self.pose(c2w)
        W, H = self.W, self.H
        i = dr.arange(mi.UInt32, W * H)
        pos = mi.Point2f((mi.Float(i % W) + 0.5) / W, (mi.Float(i // W) + 0.5) / H)
        ray, _ = self.scene.sensors()[0].sample_ray(0.0, 0.5, pos, mi.Point2f(0.5, 0.5))
        si = self.scene.ray_intersect(ray)
        p = np.array(si.p).reshape(3, -1) if np.array(si.p).shape[0] == 3 else np.array(si.p).T
        z = np.where(np.array(si.is_valid()), c2w[:3, 2] @ (p - c2w[:3, 3:4]), 0)
        ids = np.array(dr.reinterpret_array(mi.UInt32, si.shape))
        return z.reshape(H, W).astype(np.float32), ids.reshape(H, W)

    def shape_ids(self):
        return {s.id(): int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s)))[0]) for s in self.scene.shapes()}
