"""m"""

import numpy as np


def write_ply(path, mesh):
    V, F, UV, N = mesh
    rec = np.zeros(len(V), [(k, "<f4") for k in ("x", "y", "z", "nx", "ny", "nz", "u", "v")])
    for k, col in zip(rec.dtype.names, np.hstack([V, N, UV]).T):
        rec[k] = col
    fr = np.zeros(len(F), [("n", "u1"), ("i", "<i4", 3)])
    fr["n"] = 3
    fr["i"] = F
    head = "ply\nformat binary_little_endian 1.0\nelement vertex %d\n" % len(V) + "".join(
        f"property float {k}\n" for k in rec.dtype.names
    )
    head += "element face %d\nproperty list uchar int vertex_indices\nend_header\n" % len(F)
    Path(path).write_bytes(head.encode() + rec.tobytes() + fr.tobytes())


def color_node(c):
    """An RGB triple in 0..255 sRGB, or an sRGB uint8 image (row 0 at v = 1), as a Mitsuba colour/texture."""
    if isinstance(c, np.ndarray) and c.ndim == 3:
        return {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(c[::-1])),
            "filter_type": "bilinear",
            "wrap_mode": "clamp",
        }
    s = np.asarray(c, float) / 255
    return {"type": "rgb", "value": list(map(float, np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)))}


def env_node(e):
    if isinstance(e, np.ndarray):  # lat-long image, row 0 = zenith; z up
        T = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        return {"type": "envmap", "bitmap": mi.Bitmap(e.astype(np.float32)), "to_world": T}
    return {"type": "constant", "radiance": {"type": "rgb", "value": list(map(float, e))}}

    def _common(self, W, H, depth, integrator="volpath"):
        return {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": depth},
            "sensor": {
                "type": "perspective",
                "fov": self.fov,
                "fov_axis": "x",
                "near_clip": 0.02,
                "far_clip": 1000.0,
                "film": {
                    "type": "hdrfilm",
                    "width": W,
                    "height": H,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                    "component_format": "float32",
                },
                "sampler": {"type": "multijitter"},
            },
        }

    def rgb_scene(self, W, H, tmp, only=None):
        d = self._common(W, H, self.depth_rgb)
        if self.env_rgb is not None:
            d["env"] = env_node(self.env_rgb)  # none in closed rooms: it would only waste light samples
        if self.sun:
            d["sun"] = {
                "type": "directional",
                "direction": list(self.sun[0]),
                "irradiance": {"type": "rgb", "value": list(self.sun[1])},
            }
        for o in self.objs:
            if only is None or only(o):
                f = f"{tmp}/rgb_{o.name}.ply"
                write_ply(f, o.mesh_rgb or o.mesh)
                d[o.name] = {"type": "ply", "filename": f, "bsdf": o.rgb}
                if o.emit:
                    d[o.name]["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": list(o.emit)}}
        return mi.load_dict(d, parallel=False)  # parallel loading shuffles the light order, hence the noise

    def thermal_scene(self, W, H, tmp, only=None):
        d = self._common(W, H, self.depth_thermal, "emission_path")
        d["integrator"]["ambient"] = float(radiance_of(self.room_T))
        env = radiance_of(np.asarray(self.env_T if self.env_T is not None else self.room_T, float))
        d["env"] = env_node(np.repeat(env[..., None], 3, -1).astype(np.float32) if env.ndim else (float(env),) * 3)
        g = lambda v: {"type": "rgb", "value": [float(v)] * 3}
        for o in self.objs:
            if only is not None and not only(o):
                continue
            f = f"{tmp}/th_{o.name}.ply"
            write_ply(f, o.mesh)
            rho = 1 - o.eps - o.tau
            if o.tau > 0:  # index-matched: passes sqrt(tau) per face, no reflection, deterministic
                bsdf = {
                    "type": "thindielectric",
                    "int_ior": 1.0,
                    "ext_ior": 1.0,
                    "specular_transmittance": g(o.tau**0.5),
                    "specular_reflectance": g(0),
                }
            elif o.mirror is None:
                bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": g(rho)}}
            elif o.mirror == 0:
                bsdf = {
                    "type": "twosided",
                    "bsdf": {"type": "conductor", "material": "none", "specular_reflectance": g(rho)},
                }
            else:
                bsdf = {
                    "type": "twosided",
                    "bsdf": {
                        "type": "roughconductor",
                        "material": "none",
                        "alpha": o.mirror,
                        "specular_reflectance": g(rho),
                    },
                }
            L = o.eps * radiance_of(np.asarray(o.T, float))
            rad = (
                g(L)
                if L.ndim == 0
                else {
                    "type": "bitmap",
                    "bitmap": mi.Bitmap(np.ascontiguousarray(np.repeat(L[::-1, :, None], 3, 2), np.float32)),
                    "raw": True,
                    "filter_type": "bilinear",
                    "wrap_mode": "clamp",
                }
            )
            d[o.name] = {"type": "ply", "filename": f, "bsdf": bsdf, "emitter": {"type": "area", "radiance": rad}}
        return mi.load_dict(d, parallel=False)  # parallel loading shuffles the light order, hence the noise
