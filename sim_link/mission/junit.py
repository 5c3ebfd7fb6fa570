"""JUnit XML, as continuous integration reads it: a suite per flight, a case per expectation.

A flight that did not come to an end, or has no report, has a case with an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree

from sim_link.mission.summary import Summary


def junit_xml(summaries: Sequence[Summary]) -> str:
    """The document.

    Args:
        summaries: Of all flights, in the order of the document.
    """
    root = ElementTree.Element("testsuites", name="missions")
    for summary in summaries:
        root.append(_suite(summary))
    cases = [verdict for summary in summaries for verdict in summary.verdicts]
    root.set("tests", str(sum(_count(summary) for summary in summaries)))
    root.set("failures", str(sum(not verdict.is_met for verdict in cases)))
    root.set("errors", str(sum(bool(summary.error) for summary in summaries)))
    root.set("time", f"{sum(summary.wall_s for summary in summaries):.3f}")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _suite(summary: Summary) -> ElementTree.Element:
    suite = ElementTree.Element(
        "testsuite",
        name=_clean(summary.title),
        file=_clean(summary.file),
        tests=str(_count(summary)),
        failures=str(len(summary.failed)),
        errors=str(int(bool(summary.error))),
        skipped="0",
        time=f"{summary.wall_s:.3f}",
    )
    properties = ElementTree.SubElement(suite, "properties")
    for name, value in _properties(summary).items():
        ElementTree.SubElement(properties, "property", name=name, value=_clean(value))
    for number, verdict in enumerate(summary.verdicts):
        case = _case(suite, summary, verdict.name, summary.wall_s if number == 0 else 0.0)
        if not verdict.is_met:
            failure = ElementTree.SubElement(case, "failure", message=_clean(verdict.found))
            failure.text = _clean(f"{verdict.name}: {verdict.found}")
    if summary.error:
        case = _case(suite, summary, "flight and report", 0.0)
        ElementTree.SubElement(case, "error", message=_clean(summary.error))
    return suite


def _case(
    suite: ElementTree.Element, summary: Summary, name: str, time_s: float
) -> ElementTree.Element:
    return ElementTree.SubElement(
        suite,
        "testcase",
        classname=_clean(f"{summary.name}.{summary.flavour}.seed {summary.seed}"),
        name=_clean(name),
        time=f"{time_s:.3f}",
    )


def _count(summary: Summary) -> int:
    """Cases: every expectation, and what went wrong beside them."""
    return len(summary.verdicts) + bool(summary.error)


def _properties(summary: Summary) -> dict[str, str]:
    values = {
        "seed": summary.seed,
        "how": summary.how,
        "flown_s": f"{summary.time_s:.1f}",
        "distance_m": f"{summary.distance_m:.1f}",
        "final_error_m": summary.final_error_m,
        "r95_m": summary.r95_m,
        "report": summary.report or None,
    }
    return {name: str(value) for name, value in values.items() if value is not None}


def _clean(text: str) -> str:
    """Without what XML 1.0 cannot hold."""
    return "".join(c if c.isprintable() else " " for c in text)
