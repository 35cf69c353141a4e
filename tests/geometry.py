"""Whether a figure can be read: what is where, in pixels, after Matplotlib has laid it out."""


def assert_readable(figure):
    """Assert that no legend covers a panel, and that every text and legend is inside the figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    panels = [axes for axes in figure.axes if axes.get_visible()]
    legends = [*figure.legends, *(axes.get_legend() for axes in panels)]
    for legend in filter(None, legends):
        box = legend.get_window_extent(renderer)
        names = [text.get_text() for text in legend.get_texts()]
        assert _inside(box, figure.bbox), f"the legend of {names} is clipped"
        for axes in panels:
            assert not _overlap(box, axes.bbox), f"the legend of {names} covers a panel"
    for axes in panels:
        for text in (axes.title, axes.xaxis.label, axes.yaxis.label):
            if not text.get_text():
                continue
            box = text.get_window_extent(renderer)
            assert _inside(box, figure.bbox), f"{text.get_text()!r} is clipped"
            for other in panels:
                assert not _overlap(box, other.bbox), f"{text.get_text()!r} covers a panel"
    if figure._suptitle is not None:
        assert _inside(figure._suptitle.get_window_extent(renderer), figure.bbox)


def _inside(box, outer, margin=1.5):
    return bool(
        box.x0 >= outer.x0 - margin
        and box.y0 >= outer.y0 - margin
        and box.x1 <= outer.x1 + margin
        and box.y1 <= outer.y1 + margin
    )


def _overlap(one, other, margin=1.0):
    return bool(
        min(one.x1, other.x1) - max(one.x0, other.x0) > margin
        and min(one.y1, other.y1) - max(one.y0, other.y0) > margin
    )
