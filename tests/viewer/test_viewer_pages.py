"""Pages beside each other: a defect of one ends no other, each has its colours, a click shows whose and when."""

import contextlib
import re
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, call

import msgspec
import numpy as np
import pytest
from conftest import unused_port

from fleet.contract import Model, Prediction, TwinState
from tests.bench.viewing.watcher import Watcher
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import PretendFleet
from viewer.browser.http_server import Browser, serve, stop_server
from viewer.server.app import TICKS_PER_S, App
from viewer.server.view import View
from viewer.text.missed_events import encode_click, parse_click
from viewer.text.words import table
from viewer.theme.palette import DARK, LIGHT


@pytest.fixture
def site() -> Iterator[SimpleNamespace]:
    """A viewer with five aircraft that fly, and two pages on it."""
    port = unused_port()
    server, bus = serve("127.0.0.1", port), MemoryBus()
    app, fleet = App(bus, server), PretendFleet(bus, 5)
    pages = [Watcher(port), Watcher(port)]

    def run(ticks: int = 10) -> None:
        for tick in range(ticks):
            fleet.advance(time.time())
            app.tick(tick)

    while len(app.views) < 2:  # each is there once it has told its camera
        run()
    yield SimpleNamespace(app=app, bus=bus, fleet=fleet, run=run, views=[app.views[n] for n in sorted(app.views)])
    for page in pages:
        page.close()
    stop_server(server)


def broken(view: View) -> str:
    return view.panels._error.content


def test_a_defect_of_one_page_is_said_there_and_in_the_log_and_the_others_go_on(site, caplog) -> None:
    first, second = site.views
    first.scene.draw_heads = MagicMock(side_effect=KeyError("<b>seven"))
    drawn = second.scene.draw_heads = MagicMock(wraps=second.scene.draw_heads)
    site.run()
    site.run()
    assert "KeyError: &#x27;&lt;b&gt;seven" in broken(first) and "Reload" in broken(first)
    assert broken(second) == "" and drawn.call_count > 5
    said = [record for record in caplog.records if record.name == "viewer.server.app"]
    assert len(said) == 1 and said[0].exc_info and f"page {first.client.client_id}" in said[0].message
    del first.scene.draw_heads
    site.run()
    assert broken(first)  # it may stumble again at once
    first._error_time -= 10.0
    site.run()
    assert broken(first) == ""


def test_a_page_has_no_way_to_approve_unless_the_viewer_allows_it(site) -> None:
    first, second = site.views

    def hidden(view: View) -> list:
        inputs = view.client.gui._gui_input_handle_from_uuid.values()
        return [one for one in inputs if getattr(one, "label", "") == "approval"]

    assert not hidden(first) and first.panels._approval_code == "" and first.panels._approvals is None
    site.app._approver = (site.bus.publish, "kim")
    second.browser.set_theme(light=True)  # opens the view anew
    site.run()
    view = next(one for one in site.app.views.values() if one.client is second.client)
    assert len(hidden(view)) == 1 and view.panels._approval_code and not hidden(first)


def test_a_page_that_cannot_be_opened_is_left_alone(site, caplog, monkeypatch) -> None:
    number, other = sorted(site.app.views)
    del site.app.views[number]
    tried = MagicMock(side_effect=RuntimeError("no room"))
    monkeypatch.setattr("viewer.server.app.View", tried)
    site.run()
    assert tried.call_count == 1 and list(site.app.views) == [other]
    assert f"page {number} could not be opened" in caplog.text


def test_every_page_has_its_own_colours_and_goes_on_where_it_was(site) -> None:
    first, second = site.views
    first.select(3)
    first.browser.set_theme(light=True)
    site.run()
    again = site.app.views[first.client.client_id]
    assert again is not first and again.palette is LIGHT and again.selected == 3 and again.camera is first.camera
    assert site.app.views[second.client.client_id] is second and second.palette is DARK
    assert again.client.scene._handle_from_node_name and "/fleet/vehicles" in again.client.scene._handle_from_node_name


def test_a_click_on_an_alert_selects_and_shows_its_time(site) -> None:
    view = site.views[0]
    tape = site.app.recordings.by_uav[4]
    while not tape.states or tape.t[-1] - tape.states[0].t < 0.2:
        site.run()
    then = float(tape.states[0].t) + 0.1
    view.panels._pick(encode_click(4, then))
    assert view.selected == 4 and view.timeline.player.t == pytest.approx(then, abs=2e-3) and view.dirty
    site.app.draw_selections()
    assert view.selected_vehicle().shown_t == pytest.approx(then, abs=2e-3) and site.views[1].timeline.player.live
    view.panels._pick(encode_click(2, float("nan")))  # a time that is none: selected, as a row is
    assert view.selected == 2
    for mischief in ("", "x", "7@", "9999999", "1@1e400", "1@nan", "1@-3", "²", "3@" + "9" * 100):
        view.panels._pick(mischief)
    assert view.timeline.player.t == pytest.approx(then, abs=2e-3)


def test_who_is_selected_is_drawn_ahead_of_lists_and_charts(site, monkeypatch) -> None:
    view = site.views[0]
    view.select(3)
    monkeypatch.setattr(view.panels, "draw", told := MagicMock(wraps=view.panels.draw))
    site.app.draw_selections()
    assert view.selection.tags[0].text.startswith("UAV-003") and not told.called
    site.run(1)
    assert told.called


def test_nothing_is_held_back_while_lists_are_made(site, monkeypatch) -> None:
    view, held = site.views[0], []
    buffer = view.client._websock_connection.get_message_buffer()

    def made(*given, **named) -> str:
        held.append(buffer.atomic_counter)
        return table(*given, **named)

    monkeypatch.setattr("viewer.panels.panels.table", made)
    site.run()
    assert held and not any(held)


class Cursors(dict[int, int]):
    """Number of the last message sent, by client, and of all before it."""

    def __init__(self, present: dict[int, int]) -> None:
        super().__init__(present)
        self.ends: list[int] = []

    def __setitem__(self, client: int, last: int) -> None:
        self.ends.append(last)
        super().__setitem__(client, last)


def test_a_long_block_is_sent_whole(site) -> None:
    """In two frames of the socket, labels of this block could be on the screen with labels of the block before."""
    client, count = site.views[0].client, 300
    buffer = client._websock_connection.get_message_buffer()
    labels = [client.scene.add_label(f"/many/{k}", "") for k in range(count)]
    buffer.generator_cursors = cursors = Cursors(buffer.generator_cursors)
    for text in ("first", "second"):
        begin = buffer.message_counter
        with client.atomic():
            for label in labels:
                label.text = text
        end = buffer.message_counter - 1
        while cursors[client.client_id] < end:
            threading.Event().wait(0.01)
        assert end + 1 - begin == count and not any(begin <= last < end for last in cursors.ends)


def test_row_tile_label_and_ring_of_one_record_are_sent_in_one_block(site, monkeypatch) -> None:
    """A horizon that changes with every prediction; also after a change of the time shown, which is drawn at once."""
    view, block, sent, publish = site.views[0], 0, [], site.bus.publish
    buffer = view.client._websock_connection.get_message_buffer()
    push, start = buffer.push, buffer.atomic_start

    def begin() -> None:
        nonlocal block
        block += buffer.atomic_counter == 0
        start()

    def note(message: Any) -> None:
        sent.append((block if buffer.atomic_counter else -1, message))
        push(message)

    def changed(message: Any, *more: Any) -> None:
        if isinstance(message, Prediction):
            message = msgspec.structs.replace(message, horizon_s=6.0 + (message.t * 7.0) % 20.0)
        publish(message, *more)

    monkeypatch.setattr(buffer, "atomic_start", begin)
    monkeypatch.setattr(buffer, "push", note)
    monkeypatch.setattr(site.bus, "publish", changed)
    table_id, compared, ticks, shown = view.panels._table._impl.uuid, 0, 0, ""
    while compared < 6:  # in the same block
        assert ticks < 600 * TICKS_PER_S
        site.fleet.advance(time.time())
        site.app.tick(ticks % TICKS_PER_S)
        ticks += 1
        if ticks % (2 * TICKS_PER_S) == 0:
            view._redraw()
            site.app.draw_selections()
        if ticks % TICKS_PER_S:
            continue
        rows = {number: one.updates["content"] for number, one in sent if getattr(one, "uuid", "") == table_id}
        texts = [(number, getattr(one, "updates", {}).get("text", "")) for number, one in sent]
        labels = {number: text for number, text in texts if text.startswith("horizon ")}
        rings = {number for number, one in sent if getattr(one, "name", "") == "/selected/horizon"}
        assert -1 not in rows
        for (
            number,
            label,
        ) in labels.items():  # a label that finds room again is sent without the row, which is unchanged
            table = rows[max(known)] if (known := [k for k in rows if k <= number]) else shown
            row = re.search(r'<tr class="pick on".*?<span class="num">(.*?)</span>', table)
            assert row is not None and label.startswith(f"horizon {row[1]}:")
            assert number in rings or number not in rows
            compared += number in rows
        shown = rows[max(rows)] if rows else shown
        sent.clear()


def test_a_click_is_written_as_it_is_read() -> None:
    for uav, t in ((0, 0.0), (7, 1_700_000_000.125), (999_999, 3.9e9)):
        assert parse_click(encode_click(uav, t)) == (uav, pytest.approx(t, abs=1e-3))
    assert (
        parse_click(encode_click(5, np.inf)) == (5, None)
        and parse_click("5") == (5, None)
        and parse_click("5@x") is None
    )


def remembered(text: str | None, *, error: type[Exception] | None = None) -> Browser:
    client = MagicMock()
    client.local_storage.get_item.side_effect = error
    client.local_storage.get_item.return_value = text
    told = threading.Event()
    one = Browser(client, DARK, told.set)
    assert told.wait(10)
    return one


def remember(view: View, text: str) -> MagicMock:
    """Let the browser of a page answer with stored preferences; return its storage."""
    storage = view.browser._storage = MagicMock()
    storage.get_item.return_value = text
    view.browser._load_preferences()
    return storage


def test_a_page_that_reloads_has_its_aircraft_and_colours_again(site) -> None:
    view = site.views[0]
    storage = remember(view, '{"uav": 3, "light": true}')
    assert view.browser.uav == 3 and view.browser.light is True
    site.run()
    again = site.app.views[view.client.client_id]
    assert again.selected == 3 and again.palette is LIGHT and again.browser.uav is None
    again.select(1)
    site.run()
    assert call("parauav-page", '{"uav": 1, "light": true}') in storage.set_item.call_args_list


def test_colours_are_stored_before_the_page_is_drawn_again(site) -> None:
    view = site.views[0]
    storage = remember(view, '{"uav": 3, "light": false}')
    site.run()
    view.browser.set_theme(light=True)  # a page may be reloaded as soon as it has the colours
    assert storage.set_item.call_args.args[1] == '{"uav": 3, "light": true}'


@pytest.mark.parametrize(
    "text", [None, "", "[", "[7]", '{"uav": "7"}', '{"uav": true, "light": 3}', "[" * 500, "9" * 500]
)
def test_what_else_a_browser_says_is_nothing(text: str | None) -> None:
    one = remembered(text)
    assert one.uav is None and one.light is None


def test_who_was_selected_is_not_forgotten_before_it_is_there_again() -> None:
    one = remembered('{"uav": 40}')
    one.save(1)  # another is shown meanwhile
    with contextlib.suppress(IndexError):
        assert one._storage.set_item.call_args.args[1] == '{"uav": 40, "light": null}'
    assert one.uav == 40 and remembered(None, error=TimeoutError).uav is None


def test_the_table_has_the_rows_that_pass_the_search_the_worst_first(site) -> None:
    panels = site.views[0].panels

    def rows() -> tuple[str, ...]:
        return tuple(f"UAV-{int(uav):03d}" for uav in re.findall(r'data-uav="(\d+)"', panels._table.content))

    site.run()
    assert sorted(rows()) == [f"UAV-{uav:03d}" for uav in range(5)]
    assert list(rows()) != sorted(rows())  # the worst first
    panels._search.value = "uav-003"
    site.run()
    assert rows() == ("UAV-003",)


# --- one record per aircraft and instant ---


def places(view: View, uav: int) -> dict[str, tuple[str, ...]]:
    """State or age, fit and horizon of the selected UAV in every place of a page; what a place leaves out is empty."""
    row = re.search(rf'<tr [^>]*data-uav="{uav}".*?</tr>', view.panels._table.content)[0]
    cells = [re.sub("<[^>]*>", "", cell) for cell in re.findall("<td.*?</td>", row)]
    tile = dict(re.findall(r'<span class="soft">(\w+)</span><b>([^<]*)</b>', view.panels._about.content))
    tags = {tag.key: tag.text for tag in view.selection.tags}
    lost = re.search(r"link lost ([\d.]+ \w+)", cells[2])
    found = {
        "row": (cells[3] + " %" if cells[3] != "–" else "–", cells[4]),
        "tile": (tile["fit"], tile["horizon"]),
        "ring": ("", re.match("horizon (.*):", tags["horizon"])[1] if "horizon" in tags else "–"),
    }
    name = re.search(r"fit (\S+(?: %)?)  (?:no )?horizon ?(.*)", tags["name"])
    if name:
        found["label"] = (name[1], name[2] or "–")
    if lost:
        said = re.search(r"No sample for ([\d.]+ \w+):", view.panels._about.content)
        figure = re.search(r"sample</td><td[^>]*>([\d.]+ \w+) old", view.panels._facts.content)
        label = re.search(r"link lost ([\d.]+ \w+)", tags["name"])
        found |= {"age": (lost[1],), "said": (said[1],), "figure": (figure[1],), "label age": (label[1],)}
        assert "link lost" in view.panels._about.content
    return found


def test_every_place_of_a_page_shows_one_record(site) -> None:
    """Twelve seconds of data, horizons and fits that change with each message, one aircraft that falls silent."""
    sent: dict[tuple[type, int, float], Any] = {}
    publish, ring_errors, seen, fleet, start = site.bus.publish, [], set(), site.fleet, time.time() + 1.0

    def record(message, *more):
        if isinstance(message, Prediction | Model):
            horizon = 5.0 + (message.t * 7.0) % 23.0
            changed = {"horizon_s": horizon} if isinstance(message, Prediction) else {}
            message = msgspec.structs.replace(message, **changed)
            sent[type(message), message.uav, message.t] = message
        publish(message, *more)

    site.bus.publish = record
    fleet.uavs[4].state = TwinState.LINK_LOST
    for k in range(120):
        fleet.advance(start + 0.1 * k, lost_since=start + 4.0)
        site.app.tick(k % 10)
        for view, uav in zip(site.views, (0, 4), strict=True):
            if view.selected != uav:
                view.select(uav)
                continue
            if not view.panels._facts.content or k < 20:
                continue
            found = places(view, uav)
            ages = {found.pop(name)[0] for name in ("age", "said", "figure", "label age") if name in found}
            assert len(ages) <= 1, ages
            for i in range(2):
                assert len({place[i] for place in found.values() if place[i]}) == 1, found
            vehicle = view.selected_vehicle()
            message = sent.get((Prediction, uav, vehicle.forecast.t))  # else it was queried at the start
            if message is not None and found["row"][1] != "–":  # what the bus said of the same instant
                assert found["row"][1] == f"{message.horizon_s:.0f} s"
                ring = view.selection._horizon._node.points.reshape(-1, 3).mean(axis=0)
                ring_errors.append(np.linalg.norm(ring - vehicle.forecast.position_at(message.horizon_s)))
            if (model := sent.get((Model, uav, vehicle.model.t))) is not None:
                assert found["row"][0] == f"{np.mean(list(model.active_verdict.fit.values())):.0f} %"
            seen.add((uav, found["row"], *ages))
    assert len({one for one in seen if one[0] == 0}) > 5 and len({one[2] for one in seen if len(one) > 2}) > 1
    assert len(ring_errors) > 20 and max(ring_errors) < 1e-3
