"""Captures with a transforms file: ThermoScenes and nerfstudio."""
