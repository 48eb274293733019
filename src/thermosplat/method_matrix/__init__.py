"""Methods times scenes: what thermosplat-benchmark trains, measures and puts into tables.

A *cell* is one method on one scene with one seed. Each is a run folder of its own, so cells can be made on several
machines and brought together.
"""
