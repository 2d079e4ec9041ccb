"""The options of an analysis: what each may be, what the preset sets.

Checked before anything is read or computed.
"""

import numpy as np

from s4a.input.clean import check_components
from s4a.method.median import NORMS
from s4a.schema import check_switch, check_text

CHOICES = {
    "init": ("dense", "landmarks"),
    "refine": ("joint", "intrinsic"),
    "how": ("ours", "standard"),
    "norm": tuple(NORMS),
    "preset": (None, "paper"),
}
DEFAULTS = {"init": "dense", "refine": "joint", "how": "ours"}  # of the options that a preset sets
PRESETS = {None: DEFAULTS, "paper": {"init": "landmarks", "refine": "intrinsic", "how": "ours"}}
LOWEST = {"n_coarse": 100, "n_pairs": 1, "k_init": 4, "k": 4, "step": 1, "seed": 0, "n_latent": 2}
SWITCHES = ("scale", "strict", "wrap", "close_holes", "intersections")


def checked(options):
    """The options that are given, each in its range, with those of the preset.

    Parameters
    ----------
    options : dict
        Any of the options of :func:`s4a.analyse`; None for one that the preset may set.

    Returns
    -------
    dict

    Raises
    ------
    ValueError
        When one is outside its range, or contradicts the preset; the range is named.

    Examples
    --------
    >>> checked({"preset": "paper", "refine": None, "k_init": 20, "k": 100})
    {'preset': 'paper', 'refine': 'intrinsic', 'k_init': 20, 'k': 100}
    >>> checked({"preset": "paper", "refine": "joint"})
    Traceback (most recent call last):
    ValueError: preset 'paper' sets refine='intrinsic'; found refine='joint': leave out one of both
    """
    preset = options.get("preset")
    for name, legal in CHOICES.items():
        if name not in options or (options[name] is None and name in DEFAULTS):
            continue
        if options[name] not in legal:
            raise ValueError(
                f"{name} must be one of {', '.join(map(repr, legal))}; found {options[name]!r}"
            )
    options = dict(options)
    for name, value in PRESETS[preset].items():
        if preset and options.get(name) not in (None, value):
            raise ValueError(
                f"preset {preset!r} sets {name}={value!r}; found {name}={options[name]!r}: leave out one of both"
            )
        if name in options and options[name] is None:
            options[name] = value
    _check_numbers(options)
    for name in SWITCHES:
        check_switch(name, options.get(name, False))
    check_components(options.get("components", "largest"))
    for name in ("pattern", "template"):
        check_text(name, options.get(name))
    return options


def _check_numbers(options):
    for name, least in LOWEST.items():
        value = options.get(name)
        if name not in options or (name == "n_latent" and value is None):
            continue
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
            raise ValueError(f"{name} must be an integer of at least {least}; found {value!r}")
    if "k" in options and options["k"] < options.get("k_init", 0):
        raise ValueError(f"k must be at least k_init = {options['k_init']}; found {options['k']}")
    if (options.get("n_latent") or 0) > options.get("k", np.inf):
        raise ValueError(
            f"n_latent must be at most k = {options['k']}; found {options['n_latent']}"
        )


def check_against(options, names):
    """ValueError where the options do not fit the shapes of these names.

    A template that is none, too few pairs.
    """
    if options["template"] is not None and options["template"] not in names:
        raise ValueError(
            f"template {options['template']!r} is none of the shapes: {', '.join(names)}"
        )
    n = len(names)
    if options["n_pairs"] < n - 1:
        raise ValueError(
            f"n_pairs = {options['n_pairs']!r} cannot connect {n} shapes: give an integer from {n - 1} (a tree) "
            f"to {n * (n - 1) // 2} (all pairs)"
        )
