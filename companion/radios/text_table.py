"""Radios that print lines, a row each: their text in `companion radio list` and their decoder.

Sigmas are those of the makers' data sheets or of the sources that `docs/radios.md` names.
"""

from __future__ import annotations

from collections.abc import Mapping

from companion.radios.decoder import Poll, RadioKind
from companion.radios.line_forms import (
    Bu01Decoder,
    Bu03Decoder,
    ChannelSoundingDecoder,
    DopplerDecoder,
    Lr11xxDecoder,
    PozyxDecoder,
    Ryuw122Decoder,
)
from companion.radios.text_radios import (
    LinesDecoder,
    MakerfabsAtDecoder,
    SilabsAoaDecoder,
    Sx1280Decoder,
    TrekDecoder,
    UudfDecoder,
)

RANGE, ANGLES = "range", "azimuth, elevation"
AOA_TAG = "a Bluetooth tag that sends direction finding advertisements"
ANY_TRANSMITTER = "nothing: any transmitter"
MS32_S = 2**32 / 1000.0
"""Period of a 32-bit clock in milliseconds."""
_AOA: Mapping[str, object] = {"bearing_sigma_deg": 5.0, "elevation_sigma_deg": 5.0}


def _sigma(range_sigma_m: float) -> Mapping[str, object]:
    return {"range_sigma_m": range_sigma_m}


RADIOS: Mapping[str, RadioKind] = {
    kind.name: kind
    for kind in (
        RadioKind(
            "makerfabs_at",
            MakerfabsAtDecoder,
            "Makerfabs MaUWB_DW3000 with AT firmware",
            RANGE,
            "a Makerfabs anchor, or a tag with `hidden: tag`",
            defaults=_sigma(0.5),
        ),
        RadioKind(
            "trek1000",
            TrekDecoder,
            "Decawave TREK1000 and clones, mc reports",
            RANGE,
            "a TREK1000 anchor, or a tag with `hidden: tag`",
            defaults=_sigma(0.3),
        ),
        RadioKind(
            "ryuw122",
            Ryuw122Decoder,
            "REYAX RYUW122, AT+ANCHOR_SEND",
            RANGE,
            "a RYUW122 in the tag's role",
            poll=Poll("", 0.2, probe=b"AT+VER?\r\n"),
            defaults=_sigma(0.3),
        ),
        RadioKind(
            "bu01",
            Bu01Decoder,
            "Ai-Thinker BU01, M5Stack Unit UWB",
            RANGE,
            "a BU01 in the anchor's role",
            defaults=_sigma(0.3),
        ),
        RadioKind(
            "bu03",
            Bu03Decoder,
            "Ai-Thinker BU03 and BU04, AT+DISTANCE",
            RANGE,
            "a BU03 or BU04 in the other role",
            needs_emitter=True,
            poll=Poll("", 0.2, b"AT+DISTANCE\r\n"),
            defaults=_sigma(0.3),
        ),
        RadioKind(
            "pozyx",
            PozyxDecoder,
            "Pozyx, its USB port or its Arduino sketches",
            RANGE,
            "a Pozyx",
            clock_wrap_s=MS32_S,
            poll=Poll("", 0.1, probe=b"R,0,1\r"),
            defaults=_sigma(0.3),
        ),
        RadioKind(
            "uudf",
            UudfDecoder,
            "u-blox direction finding, C209 and ANNA-B4 (+UUDF)",
            ANGLES,
            AOA_TAG,
            clock_wrap_s=MS32_S,
            defaults=_AOA,
        ),
        RadioKind(
            "silabs_aoa",
            SilabsAoaDecoder,
            "Silicon Labs direction finding, JSON by MQTT",
            ANGLES,
            AOA_TAG,
            "exec",
            defaults=_AOA,
        ),
        RadioKind(
            "channel_sounding",
            ChannelSoundingDecoder,
            "Bluetooth channel sounding, lines of Nordic's and Zephyr's samples",
            RANGE,
            "a Bluetooth device that reflects channel sounding",
            needs_emitter=True,
            defaults=_sigma(0.5),
        ),
        RadioKind(
            "sx1280",
            Sx1280Decoder,
            "Semtech SX1280 ranging, lines of RadioLib and SX12XX-LoRa",
            RANGE,
            "an SX1280 in the slave role",
            needs_emitter=True,
            defaults=_sigma(3.0),
        ),
        RadioKind(
            "lr11xx",
            Lr11xxDecoder,
            "Semtech LR1110 and LR1120 ranging, lines of their SDK",
            RANGE,
            "an LR1110 or LR1120 in the subordinate role",
            needs_emitter=True,
            defaults=_sigma(10.0),
        ),
        RadioKind(
            "doppler",
            DopplerDecoder,
            "Doppler direction finders, KN5R-RDF and rotaryclub",
            "azimuth",
            ANY_TRANSMITTER,
            needs_emitter=True,
            # Of the output of an open squelch 99 % has a magnitude below 100 of 999.
            defaults={"bearing_sigma_deg": 10.0, "quality_min": 0.1},
        ),
        RadioKind(
            "lines",
            LinesDecoder,
            "any text: a regular expression of your own",
            "what its groups are called",
            "whatever the radio needs",
        ),
    )
}
"""Radios by name."""
