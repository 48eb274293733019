"""The commands. Their modules import nothing heavy before the arguments are understood, so that --help is instant."""
