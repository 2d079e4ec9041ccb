"""``rng=`` (SPEC 7) in every public function that takes a seed gives the same as ``seed=``."""

import numpy as np
import pytest

import s4a
from s4a.seeds import seed_of

STATISTICS = {
    "group_test": (["a", "b"] * 3,),
    "group_map": (["a", "b"] * 3,),
    "regression": ([3.0, 1, 4, 1, 5, 9],),
}


@pytest.fixture(scope="module")
def study(example_study):
    return example_study


def test_seed_and_rng_of_a_number_are_the_same_and_those_of_another_are_not():
    seeded = s4a.synthetic.brains(2, 200, 5)
    by_rng = s4a.synthetic.brains(2, 200, rng=5)
    other = s4a.synthetic.brains(2, 200, rng=6)
    assert seeded.identical(by_rng)
    assert not seeded["truth"].identical(other["truth"])


def test_a_study_made_by_rng_is_that_of_the_seed_and_says_which():
    shapes = s4a.synthetic.brains(3, 200)
    small = {"n_coarse": 100, "k": 10, "k_init": 6, "n_pairs": 3}
    by_seed = s4a.analyse(shapes, **small, seed=2)
    by_rng = s4a.analyse(shapes, **small, rng=2)
    assert s4a.Options.from_report(by_rng).seed == 2
    assert by_seed["registration"].identical(by_rng["registration"])


@pytest.mark.parametrize("name", STATISTICS)
def test_the_statistics_draw_the_same_permutations(study, name):
    function = getattr(s4a.statistics, name)
    by_seed, by_rng, drawn = (
        function(study, *STATISTICS[name], n_permutations=19, **options)
        for options in ({"seed": 4}, {"rng": 4}, {"rng": np.random.default_rng(4)})
    )
    assert by_seed.identical(by_rng)
    assert drawn["p_value" if "p_value" in drawn else "p_vertex"].notnull().all()


def test_the_model_draws_the_same_shapes_and_another_pair_from_one_generator(study):
    drawn = [s4a.statistics.sample(study, 2, **o)["score"] for o in ({"seed": 1}, {"rng": 1})]
    assert drawn[0].identical(drawn[1])
    rng = np.random.default_rng(1)
    first, second = (s4a.statistics.sample(study, 2, rng=rng)["score"] for _ in range(2))
    assert not first.identical(second)


def test_a_pair_takes_rng_and_refuses_both():
    ball = s4a.synthetic.ellipsoid(300)
    small = {"n_coarse": 100, "k": 10, "k_init": 6}
    by_seed = s4a.match_pair(ball, ball, **small, seed=1)
    assert by_seed.identical(s4a.match_pair(ball, ball, **small, rng=1))
    with pytest.raises(ValueError, match="leave out one of the two"):
        s4a.match_pair(ball, ball, **small, seed=1, rng=2)


@pytest.mark.parametrize("wrong", [1.5, True, "1", [1]])
def test_what_is_neither_a_number_nor_a_generator_is_refused(wrong):
    with pytest.raises(TypeError, match="rng needs a whole number or a numpy"):
        seed_of(0, wrong)


def test_a_number_below_zero_is_refused():
    with pytest.raises(ValueError, match="from 0, found -1"):
        seed_of(0, -1)
