"""What a run has to say of its own results.

Doubtful registrations, numbers reduced to what there is (4, 6.1).
"""

import numpy as np

DOUBTFUL = 0.06  # badness: of one kind 0.02 to 0.03, in far poses 0.01 to 0.03, of a cat and a man 0.14 to 0.16


def doubtful(badness):
    """Warnings for the shapes whose registration scores badly.

    See :func:`s4a.method.joint.badness`, and for all of them.

    Returns
    -------
    of_shape : dict of str to str
    of_all : list of str
        In place of the former where most shapes are doubtful: then the template or the options are.

    Examples
    --------
    >>> of_shape, of_all = doubtful({"template": 0.0, "good": 0.02, "wrong": 0.12})
    >>> list(of_shape), of_all
    (['wrong'], [])
    """
    wrong = {name: score for name, score in badness.items() if score > DOUBTFUL}
    if len(badness) > 2 and len(wrong) > len(badness) / 2:
        return {}, [
            f"{len(wrong)} of {len(badness)} registrations are doubtful (badness {min(wrong.values()):.3f} to "
            f"{max(wrong.values()):.3f}, above {DOUBTFUL}): try another template, a larger n_coarse or k"
        ]
    return {
        name: f"probably registered wrongly (badness {score:.3f}, above {DOUBTFUL}): look at it in s4a view, "
        "compare its file with the template's, or leave it out"
        for name, score in wrong.items()
    }, []


def reductions(options, names, n_pairs, k, n_eigenfunctions):
    """What of the options was reduced to what the shapes allow, in words.

    Parameters
    ----------
    options : dict
    names : list of str
    n_pairs, k : int
        Pairs and size of the maps that were used.
    n_eigenfunctions : dict of str to int

    Examples
    --------
    >>> reductions({"n_pairs": 500, "k": 100}, ["a", "b", "c"], 3, 57, {"a": 100, "b": 57, "c": 100})
    ['all 3 pairs of 3 shapes are used (n_pairs = 500)', 'k = 100 reduced to 57, the eigenfunctions of b']
    """
    found = []
    if n_pairs < options["n_pairs"]:
        found.append(
            f"all {n_pairs} pairs of {len(names)} shapes are used (n_pairs = {options['n_pairs']})"
        )
    if k < options["k"]:
        least = min(n_eigenfunctions, key=n_eigenfunctions.get)
        found.append(f"k = {options['k']} reduced to {k}, the eigenfunctions of {least}")
    return found


def tied(names, distance, relative=1e-6):
    """Whether the median shape is one of several, in words.

    Examples
    --------
    >>> tied(["b", "a"], [0.5, 0.5])
    ['the median is not unique: a, b are equally near the limit shape (of two shapes, always); one of them was taken']
    """
    distance = np.asarray(distance)
    near = [
        n
        for n, d in zip(names, distance, strict=True)
        if d <= distance.min() * (1 + relative) + 1e-9
    ]
    if len(near) < 2:
        return []
    two = " (of two shapes, always)" if len(names) == 2 else ""
    near = ", ".join(sorted(near))
    return [
        f"the median is not unique: {near} are equally near the limit shape{two}; one of them was taken"
    ]
