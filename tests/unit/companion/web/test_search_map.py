"""What a browser is sent of the track."""

from companion.web.server import TRACK_POINTS, WHOLE_EVERY, PictureFeed, TrackSent


def fly_on(hub: PictureFeed, step: int) -> None:
    hub.take({"t_s": float(step), "origin": None, "vehicle": [float(step), 0.0, 20.0]})


def test_every_browser_has_the_whole_track_though_parts_are_sent() -> None:
    hub, early, late = PictureFeed({}), TrackSent(), TrackSent()
    tracks: dict[TrackSent, list[tuple[float, float]]] = {early: [], late: []}
    sent = 0
    for step in range(2 * TRACK_POINTS):
        fly_on(hub, step)
        for browser in (early, late) if step > 700 else (early,):
            points, is_whole = browser.next_part(hub)
            tracks[browser] = points if is_whole else tracks[browser] + points
            assert tracks[browser] == hub.track
            sent += len(points)
    assert sent < 4 * 2 * TRACK_POINTS * TRACK_POINTS / WHOLE_EVERY


def test_a_part_that_was_lost_is_made_good() -> None:
    hub, browser = PictureFeed({}), TrackSent()
    wholes = []
    for step in range(3 * WHOLE_EVERY):
        fly_on(hub, step)
        wholes.append(browser.next_part(hub)[1])
    assert [step for step, is_whole in enumerate(wholes) if is_whole][1:] == [
        WHOLE_EVERY,
        2 * WHOLE_EVERY,
    ]
