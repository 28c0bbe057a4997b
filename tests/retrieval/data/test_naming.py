"""Objects derived from photo paths (`build-index --objects-from`), and warnings about suspicious names."""

import pytest

from retrieval.data.naming import Naming, naming_warnings
from retrieval.errors import BadInput

BY_RULE = {
    "folder": {
        "mug/1.jpg": "mug",
        "train/mug/0.jpg": "train",
        "mug_0.jpg": "mug_0",
        "v1.2.tif": "v1.2",
    },
    "stem": {
        "mug-12.jpg": "mug",
        "mug (3).jpg": "mug",
        "mug7.png": "mug",
        "train/mug_1.jpg": "mug",
        "red mug.jpg": "red mug",
        "mug_left.jpg": "mug_left",
        "mug_1_2.jpg": "mug_1",
        "mug/0.jpg": None,
        "2024.jpg": None,
    },
    "{split}/{object}/{photo}": {
        "train/mug/0.jpg": "mug",
        "test/red mug/a.b.png": "red mug",
        "mug/0.jpg": None,
        "a/b/c/0.jpg": None,
    },
    "{object}_{view}.jpg": {
        "mug_0.jpg": "mug",
        "red_mug_0.jpg": "red_mug",
        "mug_0.png": None,
        "mug.jpg": None,
        "train/mug_0.jpg": None,
    },
    "{split}_{object}_{view}": {"train_red_mug_0.jpg": "red_mug", "a_b_c_d_e.jpg": "b_c_d"},
    "{object}/{object}_{view}": {"mug/mug_0.jpg": "mug", "mug/cup_0.jpg": None},
    "photos (new)/{object}+{n}": {"photos (new)/mug+1.jpg": "mug", "photos new/mug+1.jpg": None},
}


@pytest.mark.parametrize("rule", BY_RULE)
def test_a_rule_gives_the_object_of_a_path_or_none_where_it_does_not_fit(rule):
    assert {path: Naming(rule).object_of(path) for path in BY_RULE[rule]} == BY_RULE[rule]


@pytest.mark.parametrize(
    ("rule", "message"),
    {
        "stems": "must be named from folder, stem, or a pattern with {object}",
        "{object}/{a b}": "braces in a pattern must contain one word each",
        "{object}{view}": "must have text between them",
    }.items(),
)
def test_an_invalid_rule_is_refused_with_the_valid_forms(rule, message):
    with pytest.raises(BadInput) as raised:
        Naming(rule)
    assert message in str(raised.value)
    assert "{split}/{object}/{photo}" in str(raised.value)


def warnings(photos, rule="folder"):
    """Return the warnings on objects with these numbers of photos."""
    pairs = [(name, f"{name}/{number}.jpg") for name, count in photos.items() for number in range(count)]
    return naming_warnings(pairs, Naming(rule))


def test_plausible_names_give_no_warning():
    assert warnings({"mug": 3, "cup": 3, "trainer": 1}) == []
    assert warnings({"1": 3, "2": 3}) == []  # a number is a valid name
    assert warnings({"slab-knurl-20000-00010": 3, "cone-ribs-20000-00015": 3}) == []
    # The rule stem has already removed the last number of mug_1_5.jpg.
    assert warnings({"mug_1": 2, "mug_2": 2}, "stem") == []
