"""The options of the small study that tests share, as of Python and of the command line."""

OPTIONS = {"n_coarse": 400, "k_init": 10, "k": 24, "n_jobs": 1}
FLAGS = [
    word for name, value in OPTIONS.items() for word in (f"--{name.replace('_', '-')}", str(value))
]
