"""The steps of thermosplat-prepare as subcommands."""
