"""m"""


def register_emission_path():
    """Thermal integrator: Mitsuba ray intersection, BSDF sampling and emission; no light sampling.  Every surface is an
    emitter here, so BSDF sampling alone is the better estimator; and Mitsuba's own `path` is biased for these scenes,
    because it importance-samples emission textures through uv -> surface, which is not unique on a box."""

    class EmissionPath(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.n, self.ambient = props.get("max_depth", 5), props.get("ambient", 0.0)

        def sample(self, scene, sampler, ray, medium=None, active=True):
            L, beta, active, valid, ray = (
                mi.Spectrum(0.0),
                mi.Spectrum(1.0),
                mi.Bool(active),
                mi.Bool(False),
                mi.Ray3f(ray),
            )
            for k in range(self.n):
                si = scene.ray_intersect(ray, active)
                away = si.is_valid() & (
                    dr.dot(si.sh_frame.n, ray.d) * dr.dot(si.n, ray.d) <= 0
                )  # smooth normal past the silhouette
                si.sh_frame = dr.select(away, mi.Frame3f(si.n), si.sh_frame)
                si.wi = dr.select(away, si.to_local(-ray.d), si.wi)
                L += dr.select(active, beta * si.emitter(scene, active).eval(si, active), 0.0)
                if k == 0:
                    valid = active & si.is_valid()
                active &= si.is_valid()
                bs, w = si.bsdf(ray).sample(
                    mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active
                )
                beta = dr.select(active, beta * w, beta)
                stop = active & ((dr.max(beta) < 0.01) | (k == self.n - 1))
                L += dr.select(stop, beta * self.ambient, 0.0)  # what is left sees ambient radiance
                active &= ~stop
                ray = si.spawn_ray(si.to_world(bs.wo))
            return L, valid, []

    mi.register_integrator("emission_path", lambda p: EmissionPath(p))
