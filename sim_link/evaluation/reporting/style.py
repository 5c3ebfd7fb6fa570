"""One look for every figure: colours, lines, lettering, and files that are the same bytes.

A planner has its colour and a filter its line, everywhere. The colours are those of M. Okabe and
K. Ito, "Color Universal Design" (2008), the light ones darkened until they hold on white paper; no
two planners are told apart by colour alone, because lines carry their names at their ends.

On the page a figure is inline SVG whose colours are variables of the page, so that it follows a
dark or a light theme; as a file it stands on white.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO, StringIO
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from sim_link.evaluation.systems import FilterName, PlannerName

INK, MUTED, GRID, PAGE = "#1c1d22", "#6a6e79", "#dcdee4", "#ffffff"
SHADE, SOLID = "#eceef2", "#c3c7d0"
PASSIVE, LATCHED, FIM, TRUTH = "#b96a00", "#0072b2", "#b8488f", "#00845f"
PRINTED_FIM = "#c8322b"
PLANNER_COLOURS: dict[PlannerName, str] = {
    "passive": PASSIVE,
    "reactive": INK,
    "latched": LATCHED,
    "fim": FIM,
    "fim_printed": PRINTED_FIM,
}
FILTER_DASHES: dict[FilterName, tuple[float, ...]] = {
    "asymmetric_huber": (),
    "map": (),
    "huber": (5.0, 1.6),
    "admm": (5.0, 1.6, 1.2, 1.6),
    "ekf": (2.4, 1.4),
}
DOTS = (1.0, 1.6)
"""Of a bound."""
THEMED = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    PAGE: "surface",
    SHADE: "shade",
    SOLID: "solid",
    PASSIVE: "passive",
    LATCHED: "latched",
    FIM: "fim",
    PRINTED_FIM: "printed-fim",
    TRUTH: "truth",
}
"""The page's variables for the colours of a figure."""
DPI = 180
LABEL_GAP_PT = 10.5
"""Between the baselines of two labels."""

RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "text.color": INK,
    "lines.linewidth": 1.5,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "figure.facecolor": PAGE,
    "axes.facecolor": "none",
    "savefig.facecolor": PAGE,
    "svg.fonttype": "path",
    "figure.constrained_layout.use": True,
}


@dataclass(frozen=True, slots=True)
class Drawing:
    """A finished figure."""

    name: str
    """Of its files, without an ending."""
    title: str
    caption: str
    svg: str
    png: bytes
    is_wide: bool = False
    """Whether it wants the whole width of a page."""


@contextmanager
def look() -> Iterator[None]:
    """The look of every figure made inside, whatever the user's own settings are."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(RC)
        yield


def new_figure(width_in: float, height_in: float) -> Figure:
    """A figure that belongs to no window and no global state."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def finished(figure: Figure, name: str, title: str, caption: str, *, wide: bool = False) -> Drawing:
    """The figure as files, without dates and with names that follow from its own."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # laid out once for both files
    return Drawing(name, title, caption, _svg(figure, name), _png(figure), wide)


def inline(drawing: Drawing) -> str:
    """The SVG as part of a page: its own ids, the page's colours, no fixed size."""
    text = drawing.svg[drawing.svg.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{drawing.name}-', text)
    text = text.replace("url(#", f"url(#{drawing.name}-")
    text = text.replace('href="#', f'href="#{drawing.name}-')
    text = re.sub(r'<svg ([^>]*?)width="[^"]*"', r"<svg \1", text, count=1)
    text = re.sub(r'<svg ([^>]*?)height="[^"]*"', r"<svg \1", text, count=1)
    for colour, variable in THEMED.items():
        text = text.replace(colour, f"var(--{variable})")
    return text.replace("<svg ", '<svg role="img" ', 1).strip()


def label_ends(
    figure: Figure,
    axes: Axes,
    labels: Sequence[tuple[float, str, str]],
    least_gap_pt: float = LABEL_GAP_PT,
) -> None:
    """Write names at the right ends of lines, moved apart where they would collide.

    Args:
        figure: Laid out.
        axes: With its limits and scales set.
        labels: Where in data (y), what, and in which colour.
        least_gap_pt: Between two labels.
    """
    height_pt = axes.get_position().height * figure.get_figheight() * 72.0
    shares = axes.transAxes.inverted()
    ordered = sorted(
        (float(shares.transform(axes.transData.transform((1.0, y)))[1]), text, colour)
        for y, text, colour in labels
    )
    places = spread([place for place, _, _ in ordered], least_gap_pt / height_pt)
    for (wanted, text, colour), place in zip(ordered, places, strict=True):
        axes.annotate(
            text,
            xy=(1.0, wanted),
            xytext=(1.035, place),
            xycoords="axes fraction",
            textcoords="axes fraction",
            color=colour,
            va="center",
            fontsize=8.0,
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": colour,
                "lw": 0.5,
                "shrinkA": 1.0,
                "shrinkB": 0.0,
                "relpos": (0.0, 0.5),
            },
        )


def spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Ascending places at least `gap` apart and, in sum, as near to the wanted ones as can be.

    Groups that collide are centred on the mean of what they want.
    """
    groups: list[tuple[float, int]] = []  # the centre, and how many
    for place in wanted:
        groups.append((place, 1))
        while len(groups) > 1:
            (low, m), (high, n) = groups[-2:]
            if high - low >= 0.5 * (m + n) * gap:
                break
            groups[-2:] = [((low * m + high * n) / (m + n), m + n)]
    return [
        centre + (index - 0.5 * (count - 1)) * gap
        for centre, count in groups
        for index in range(count)
    ]


def _svg(figure: Figure, name: str) -> str:
    text = StringIO()
    canvas: Any = FigureCanvasSVG(figure)
    with mpl.rc_context({"svg.hashsalt": name}):
        canvas.print_svg(text, metadata={"Date": None, "Creator": None})
    return text.getvalue()


def _png(figure: Figure) -> bytes:
    data = BytesIO()
    canvas: Any = FigureCanvasAgg(figure)
    canvas.print_png(data, metadata={"Software": None})
    return data.getvalue()
