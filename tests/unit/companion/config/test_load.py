from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest

from companion.config.loader import load_yaml, parse_yaml
from companion.domain import Params, Positive
from companion.errors import ConfigError


class FilterParams(Params, frozen=True):
    range_sigma_m: Positive = 3.0
    window: Annotated[int, msgspec.Meta(ge=1)] = 10
    low_m: float = 1.0
    high_m: float = 2.0

    def __post_init__(self) -> None:
        if self.low_m >= self.high_m:
            raise ValueError("low_m must be below\nhigh_m")


class Settings(Params, frozen=True):
    filter: FilterParams = FilterParams()
    fence_m: tuple[tuple[float, float], ...] = ()
    zones: tuple[FilterParams, ...] = ()
    name: str = "flight"
    order: Literal["first", "nearest"] = "first"
    ids: dict[str, int] = msgspec.field(default_factory=dict)


class Named(Params, frozen=True):
    name: str


def test_values_are_read_and_the_rest_keeps_its_default() -> None:
    settings = parse_yaml("filter: {range_sigma_m: 5}\nfence_m: [[0, 1.5]]", Settings, "a.yaml")
    assert settings.filter == FilterParams(range_sigma_m=5.0)
    assert settings.fence_m == ((0.0, 1.5),)
    assert settings.name == "flight"


@pytest.mark.parametrize("text", ["", "\n", "# only a comment\n", "---\n", "{}", "null"])
def test_an_empty_document_is_all_defaults(text: str) -> None:
    assert parse_yaml(text, Settings, "a.yaml") == Settings()


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "1.0e-3", "0.001", "+1e-3"])
def test_a_power_of_ten_is_a_number_with_or_without_a_point(text: str) -> None:
    assert (
        parse_yaml(f"filter: {{range_sigma_m: {text}}}", Settings, "a").filter.range_sigma_m == 1e-3
    )


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("filter: {range_sigma_m: 0}", "$.filter.range_sigma_m", "> 0.0"),
        ("filter: {range_sigma_m: yes}", "$.filter.range_sigma_m", "expected a number, got true"),
        ("filter: {range_sigma_m: '3'}", "$.filter.range_sigma_m", "got text: 3"),
        ("filter: {window: 2.5}", "$.filter.window", "a whole number, got 2.5"),
        ("filter: {sigma: 1}", "$.filter.sigma", "unknown key"),
        ("colour: red", "$.colour", "unknown key"),
        ("fence_m: [[1, a]]", "$.fence_m[0][1]", "got text: a"),
        ("fence_m: [[1, .nan]]", "$.fence_m[0][1]", "finite"),
        ("filter: {range_sigma_m: .inf}", "$.filter.range_sigma_m", "finite"),
        ("filter: {range_sigma_m: -.inf}", "$.filter.range_sigma_m", "finite"),
        ("filter: {range_sigma_m: 1e-308}", "$.filter.range_sigma_m", "close to zero"),
        ("filter: {range_sigma_m: 1e999}", "$.filter.range_sigma_m", "finite"),
        ("filter: {low_m: 3}", "$.filter", "low_m must be below high_m"),
        ("zones: [{}, {low_m: 3}]", "$.zones[1]", "low_m must be below high_m"),
        ("[1, 2]", "$", "got a list"),
        ("just words", "$", "got text"),
        ("3", "$", "got 3"),
        ("1: 2", "$.1", "unknown key"),
        ("filter: {true: 2}", "$.filter.true", "unknown key"),
        ("filter: {rang_sigma_m: 2}", "$.filter.rang_sigma_m", "did you mean range_sigma_m?"),
        ("fliter: {}", "$.fliter", "did you mean filter?"),
        ("zones: [{Window: 2}]", "$.zones[0].Window", "did you mean window?"),
        ("window: 2", "$.window", "it belongs in filter"),
        ("filter: {\u00a0window: 2}", "$.filter.", "an unusual space"),
        ("order: frist", "$.order", "frist is none of first, nearest"),
        ("filter: {low_m: '1,5'}", "$.filter.low_m", "got text: 1,5"),
    ],
)
def test_a_wrong_value_is_named_by_file_and_path_in_one_line(
    text: str, where: str, what: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, Settings, "site.yaml")
    message = str(caught.value)
    assert message.startswith("site.yaml: ")
    assert f" {where}" in message
    assert what in message
    assert "\n" not in message


def test_a_missing_required_key_is_named() -> None:
    with pytest.raises(ConfigError, match=r"a\.yaml: \$\.name: required key is missing"):
        parse_yaml("", Named, "a.yaml")


def test_a_key_given_twice_is_refused_with_its_line() -> None:
    with pytest.raises(ConfigError, match=r"line 3, column 1: the key `name` is given twice"):
        parse_yaml("name: a\nfilter: {}\nname: b\n", Settings, "a.yaml")


def test_a_key_is_text_as_it_is_written() -> None:
    text = "ids: {0012: 1, 1E23: 2, 0x1a2b: 3, no: 4, 11:22:33:44:55:16: 5, 7: 6}"
    names = ["0012", "1E23", "0x1a2b", "no", "11:22:33:44:55:16", "7"]
    assert parse_yaml(text, Settings, "a.yaml").ids == dict(zip(names, range(1, 7), strict=True))


def test_a_key_given_twice_in_two_notations_of_text_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"the key `7` is given twice"):
        parse_yaml("ids: {7: 1, '7': 2}", Settings, "a.yaml")


def test_an_alias_may_be_used_more_than_once() -> None:
    settings = parse_yaml("zones: [&a {window: 2}, *a]", Settings, "a.yaml")
    assert settings.zones == (FilterParams(window=2), FilterParams(window=2))


@pytest.mark.parametrize(
    "text",
    [
        "filter: [1, 2",
        "filter:\n\t- 1",
        "a: b: c",
        "name: 'open",
        "name: *nowhere",
        "--- 1\n--- 2",
        "name: !!python/object:os.system x",
        "{[1]: 2}",
        "name: \x00",
        "name: 2026-13-45",
        "name: " + "[" * 5000,
        "filter: &f {zones: *f}",
        "filter: {window: 1" + "0" * 5000 + "}",
        "filter: {range_sigma_m: 1" + "0" * 400 + "}",
        "fence_m: &f [*f]",
    ],
)
def test_broken_yaml_is_a_config_error_in_one_line(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, Settings, "a.yaml")
    assert str(caught.value).startswith("a.yaml:")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            "filter:\n  window: 2:00",
            "line 2, column 11: the number `2:00` would be read in base six",
        ),
        (
            "filter:\n  window: 1:2.5",
            "line 2, column 11: the number `1:2.5` would be read in base s",
        ),
        (
            "filter: {window: 020}",
            "line 1, column 18: the number `020` would be read in base eight;",
        ),
        (
            "filter: {window: -0_12}",
            "line 1, column 18: the number `-0_12` would be read in base e",
        ),
        ("\nfilter: {window: 1" + "0" * 5000 + "}", "line 2, column 18: the number `1000000000000"),
        ("filter:\n  name: a\0b", "line 2: has characters that cannot be shown"),
        ('name: "a\\e[31mb"', "$.name: has characters that cannot be shown"),
        ('name: "a\\uD800b"', "$.name: has characters that cannot be shown"),
        ('name: "a\\u202Eb"', "$.name: has characters that cannot be shown"),
    ],
)
def test_what_yaml_reads_otherwise_than_people_is_refused_with_its_place(
    text: str, problem: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, Settings, "a.yaml")
    assert str(caught.value).startswith(f"a.yaml: {problem}")


def test_a_leading_zero_before_one_digit_or_a_point_is_read() -> None:
    settings = parse_yaml("filter: {window: 07, range_sigma_m: 010.5}", Settings, "a.yaml")
    assert settings.filter == FilterParams(window=7, range_sigma_m=10.5)


def test_a_syntax_error_tells_line_and_column() -> None:
    with pytest.raises(ConfigError, match=r"^a\.yaml: line 2, column \d+: "):
        parse_yaml("name: a\nfilter: }", Settings, "a.yaml")


def test_a_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    path.write_text("\ufeffname: Größe\n", encoding="utf-8")
    assert load_yaml(path, Settings).name == "Größe"


def test_a_missing_file_says_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: no such file"):
        load_yaml(tmp_path / "nowhere.yaml", Settings)


def test_a_directory_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_yaml(tmp_path, Settings)


def test_a_file_that_is_not_utf8_says_so(tmp_path: Path) -> None:
    path = tmp_path / "latin.yaml"
    path.write_bytes("name: Größe".encode("latin-1"))
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_yaml(path, Settings)


def test_every_problem_of_a_file_has_its_line() -> None:
    text = """
filter: {range_sigma_m: 0, windo: 3, window: none}
fence_m: [[1, .nan], [a, 2]]
zones: [{low_m: 3}]
colour: red
3: 4
name: [1]
"""
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, Settings, "site.yaml")
    lines = str(caught.value).splitlines()
    assert [line.split(": ")[:2] for line in lines] == [
        ["site.yaml", "$.fence_m[0][1]"],
        ["site.yaml", "$.filter.range_sigma_m"],
        ["site.yaml", "$.filter.windo"],
        ["site.yaml", "$.filter.window"],
        ["site.yaml", "$.zones[0]"],
        ["site.yaml", "$.colour"],
        ["site.yaml", "$.3"],
        ["site.yaml", "$.name"],
    ]


def test_a_long_list_of_problems_is_cut_off() -> None:
    text = "\n".join(f"key_{number}: 1" for number in range(1000))
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, Settings, "site.yaml")
    assert len(str(caught.value).splitlines()) == 20


def test_a_file_that_is_far_too_large_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"# nothing\n" * 200_000)
    with pytest.raises(ConfigError, match="larger than 100 kB"):
        load_yaml(path, Settings)


def many(count: int = 80_000) -> dict[str, str]:
    """Return files that are meant to keep a reader busy, by what is in them."""
    base = ",".join(f"k{number}: 1" for number in range(1500))
    bomb = ["a0: &a0 [1,2,3,4,5,6,7,8,9]"]
    bomb += [f"a{n}: &a{n} [{','.join(9 * [f'*a{n - 1}'])}]" for n in range(1, 30)]
    return {
        "unknown keys": "\n".join(f"key_{number}: 1" for number in range(count)),
        "unknown keys, as many as are read": "\n".join(f"k{n}: 1" for n in range(count // 4)),
        "one key again and again": "filter: {" + ",".join(count * ["a: 1"]) + "}",
        "wrong values": "fence_m: [" + ",".join(count * ["x"]) + "]",
        "nested": "filter: " + count * "{a: " + count * "}",
        "nested lists": "fence_m: " + count * "[" + count * "]",
        "complex keys": "? [" + ",".join(count * ["a"]) + "]\n: 1",
        "aliases of aliases": "\n".join([*bomb, "fence_m: *a29"]),
        "merges": f"a: &a {{{base}}}\n" + "\n".join(f"x{n}: {{<<: *a}}" for n in range(9000)),
        "merges of merges": "x0: &x0 {a: 1}\n"
        + "\n".join(f"x{n}: &x{n} {{<<: [{','.join(9 * [f'*x{n - 1}'])}]}}" for n in range(1, 30)),
    }


@pytest.mark.parametrize("kind", many(4))
def test_a_file_that_is_meant_to_keep_it_busy_is_refused_at_once(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "many.yaml"
    path.write_text(many()[kind])
    began_s = time.process_time()
    with pytest.raises(ConfigError) as refused:
        load_yaml(path, Settings)
    assert time.process_time() - began_s < 2.0
    lines = str(refused.value).splitlines()
    assert len(lines) <= 20
    assert max(map(len, lines)) < 300
