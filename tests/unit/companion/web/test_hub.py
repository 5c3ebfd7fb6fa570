"""What the page's process makes of the pictures."""

from companion.web.server import PictureFeed

FIRST = {"t_s": 1.0, "track": [[[0.0, 0.0], [5.0, 0.0]], True], "curve": [[{"t_s": 1.0}], True]}


def test_a_picture_brings_what_the_page_lacks() -> None:
    hub = PictureFeed({})
    hub.take(dict(FIRST))
    hub.take({"t_s": 2.0, "track": [[[9.0, 9.0]], False], "curve": [[], False]})
    assert hub.track.items == [[0.0, 0.0], [5.0, 0.0], [9.0, 9.0]]
    assert [point["t_s"] for point in hub.curve.items] == [1.0]
    assert hub.picture == {"t_s": 2.0}
    assert hub.version == 2


def test_a_whole_track_replaces_what_was_there() -> None:
    hub = PictureFeed({})
    hub.take(dict(FIRST))
    version = hub.track.version
    hub.take({"t_s": 0.1, "track": [[[1.0, 1.0]], True]})
    assert hub.track.items == [[1.0, 1.0]]
    assert hub.track.version != version
