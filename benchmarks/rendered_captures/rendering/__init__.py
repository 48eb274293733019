"""From a scene to radiance, by Mitsuba 3."""
