"""Texts to the operator about an antenna."""

from __future__ import annotations

from companion.guidance.commands import Announce
from companion.guidance.messages import ANTENNA_TEXTS, AntennaMessages


def test_each_cause_is_reported_once_and_an_azimuth_is_no_news() -> None:
    messages = AntennaMessages()
    shown = (None, "azimuth", "planar", "line", "planar", None, "contradicted", "line")
    commands = [command for each in shown for command in messages.messages_for(each)]
    texts = [command.text for command in commands if isinstance(command, Announce)]
    assert texts == [ANTENNA_TEXTS[each] for each in ("planar", "line", "contradicted")]
