"""The server of a review: what it answers, and above all what it refuses."""

from __future__ import annotations

import http.client
import json
import threading
from contextlib import closing, contextmanager
from dataclasses import dataclass

import pytest

import tomopose as tp
from tomopose.calibration.records.decisions import read_decisions
from tomopose.errors import InputError
from tomopose.review.app import Desk, make_app
from tomopose.review.guard import BODY_BYTES, host_name, new_token
from tomopose.review.server import address_of, loopback_socket
from tomopose.review.session import begin


@dataclass
class Served:
    port: int
    token: str
    desk: Desk
    saved: list

    def ask(self, method: str, path: str, body: object = None, **headers: str) -> tuple[int, dict, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        sent = {k.replace("_", "-"): v for k, v in headers.items()}
        data = None
        if body is not None:
            data = body if isinstance(body, bytes) else json.dumps(body).encode()
            sent = {"content-type": "application/json", **sent}
        connection.request(method, path, body=data, headers=sent)
        with closing(connection), connection.getresponse() as answer:
            return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()

    def own(self, method: str, path: str, body: object = None, **headers: str) -> tuple[int, dict, bytes]:
        return self.ask(method, f"/{self.token}/{path}", body, **headers)


@pytest.fixture(scope="module")
def served(module_project):
    """For requests that change nothing."""
    with serving(module_project) as running:
        yield running


@pytest.fixture
def fresh(project):
    """For decisions."""
    with serving(project) as running:
        yield running


@contextmanager
def serving(project):
    import uvicorn

    scanner, poses = tp.read_scanner(project.folder / "scanner.json"), tp.read_poses(project.folder / "poses.csv")
    observations = tp.read_observations(project.folder / "observations.csv")
    review = begin(observations, poses, (), lambda o: tp.calibrate(scanner, poses, o))
    images = tp.open_images(project.folder / "radiographs", scanner)
    saved: list = []
    desk = Desk(
        review=review, journal=project.cal / "review.jsonl", who="N. Sato", images=images, ball_diameter=8.0,
        save=lambda r: saved.append(r) or ["x.json"],
    )  # fmt: skip
    token, listening = new_token(), loopback_socket(0)
    server = uvicorn.Server(uvicorn.Config(make_app(desk, token=token), log_level="error", access_log=False))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    yield Served(port=listening.getsockname()[1], token=token, desk=desk, saved=saved)
    server.should_exit = True
    thread.join(timeout=30)
    listening.close()
    assert not thread.is_alive()


def test_requests_from_elsewhere_are_refused(served):
    own = f"/{served.token}/state"
    cases = {
        "no token": (served.ask("GET", "/state"), 403),
        "no path": (served.ask("GET", "/"), 403),
        "another token": (served.ask("GET", f"/{new_token()}/state"), 403),
        "the beginning of the token": (served.ask("GET", f"/{served.token[:-1]}/state"), 403),
        "a foreign host": (served.ask("GET", own, Host="evil.example"), 421),
        "a foreign host that begins as ours": (served.ask("GET", own, Host="localhost.evil.example:80"), 421),
        "a foreign origin": (served.ask("GET", own, Origin="http://evil.example"), 403),
        "no origin of a page": (served.ask("GET", own, Origin="null"), 403),
        "another port's origin": (served.ask("POST", f"/{served.token}/undo", {}, Origin="http://127.0.0.1:1"), 403),
        "another site": (served.ask("GET", own, Sec_Fetch_Site="cross-site"), 403),
        "a neighbour site": (served.ask("GET", own, Sec_Fetch_Site="same-site"), 403),
        "a body that is too long": (served.own("POST", "decide", b"x" * (BODY_BYTES + 1)), 413),
    }
    assert {name: answer[0] for name, (answer, _) in cases.items()} == {n: status for n, (_, status) in cases.items()}
    assert all(b"p000" not in answer[2] for answer, _ in cases.values())
    assert not served.desk.journal.exists()


def test_a_forwarded_port_and_every_name_of_the_loopback_are_answered(served):
    for host in ("localhost:9000", "127.0.0.1:9000", "[::1]:9000", "LOCALHOST"):
        origin = f"http://{host}"
        assert served.own("GET", "state", Host=host, Origin=origin, Sec_Fetch_Site="same-origin")[0] == 200, host


@pytest.mark.parametrize("host", ["", "]", "[", "localhost@evil.example", "evil.example:80", "127.0.0.1.evil.example"])
def test_a_host_that_is_not_ours_is_not_taken_for_it(host):
    assert host_name(host) not in ("127.0.0.1", "localhost", "::1")


@pytest.mark.parametrize(
    "path",
    [
        "static/../../../../etc/passwd", "static/..%2f..%2f..%2fetc%2fpasswd", "static/%2e%2e/app.py",
        "static//etc/passwd", "..%2f..%2fetc/passwd", "static/app.js%00.css", "static/index.html",
        "crop/../../state.json", "static/../app.py",
        "crop/100000?u=1&v=1&half=9", "crop/-1?u=1&v=1&half=9", "calibration.json", "static/__init__.py",
    ],
)  # fmt: skip
def test_paths_outside_of_what_is_served_are_not_found(served, path):
    status, _, body = served.own("GET", path)
    assert status == 404
    assert b"root:" not in body
    assert b"import" not in body


def test_every_answer_forbids_other_sources(served):
    for path in ("", "state", "static/app.js", "nothing"):
        _, headers, _ = served.own("GET", path)
        assert headers["content-security-policy"].startswith("default-src 'none'; script-src 'self'")
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cache-control"] == "no-store"
        assert "access-control-allow-origin" not in headers


def test_the_page_names_nothing_from_elsewhere(served):
    _, _, page = served.own("GET", "")
    names = [n for n in page.decode().split('"') if n.startswith("static/")]
    assert len(names) == 6
    for name in names:
        status, _, text = served.own("GET", name)
        assert status == 200
        assert b"http:" not in text.replace(b"http://www.w3.org/2000/svg", b"")
        assert b"https:" not in text


def test_decisions_are_kept_as_lines_and_undo_drops_the_last(fresh):
    status, _, body = fresh.own("POST", "decide", {"row": 3, "action": "leave-out", "why": " dust "})
    assert status == 200
    assert json.loads(body)["rows"]["3"]["words"] == "left out by N. Sato: dust"
    assert fresh.own("POST", "decide", {"row": 4, "action": "accept"})[0] == 200
    assert [(d.pose_id, d.action, d.why) for d in read_decisions(fresh.desk.journal)] == [
        ("p003", "leave-out", "dust"), ("p004", "accept", ""),
    ]  # fmt: skip
    assert fresh.own("POST", "undo", {})[0] == 200
    assert [d.pose_id for d in read_decisions(fresh.desk.journal)] == ["p003"]
    assert json.loads(fresh.own("POST", "save", {})[2]) == {"written": ["x.json"]}
    assert [d.pose_id for d in fresh.saved[0].decisions] == ["p003"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"row": -1, "action": "accept"}, "row is -1"),
        ({"row": 200, "action": "accept"}, "from 0 to 199"),
        ({"row": True, "action": "accept"}, "row is True"),
        ({"row": "3", "action": "accept"}, "row is '3'"),
        ({"row": 3, "action": "delete"}, "'delete' is unknown"),
        ({"row": 3, "action": "accept", "why": 4}, "must be text"),
        ({"row": 3, "action": "accept", "why": "x" * 2001}, "at most 2000"),
        ({"row": 3, "action": "measure-again"}, "start is None"),
        ({"row": 3, "action": "measure-again", "start": [1.0, "a"]}, "start is"),
        ({"row": 0, "action": "measure-again", "start": [20.0, 20.0]}, "measured again from"),
        ([1], "a JSON object"),
        (b"{", "not JSON"),
    ],
)
def test_a_bad_decision_changes_nothing(served, content, words):
    before = served.desk.review
    status, _, body = served.own("POST", "decide", content)
    assert status == 400
    assert words in json.loads(body)["error"]
    assert served.desk.review is before
    assert not served.desk.journal.exists()


def test_a_decision_that_leaves_too_few_poses_is_refused(fresh):
    few = fresh.desk.review.detected.select(range(0, 200, 25))
    solve = fresh.desk.review.solve
    fresh.desk.review = begin(few, fresh.desk.review.poses, (), solve)
    last = 0
    for k in range(8):
        last, _, body = fresh.own("POST", "decide", {"row": k, "action": "leave-out"})
        if last == 400:
            break
    assert last == 400
    assert "error" in json.loads(body)
    assert len(read_decisions(fresh.desk.journal)) == len(fresh.desk.review.decisions) == k


def test_a_form_of_another_page_cannot_decide(served):
    status, _, _ = served.own("POST", "decide", b'{"row": 3, "action": "accept"}', content_type="text/plain")
    assert status == 400
    assert served.own("GET", "decide")[0] in (404, 405)


def test_only_the_loopback_listens():
    listening = loopback_socket(0)
    assert listening.getsockname()[0] == "127.0.0.1"
    assert address_of(listening, "abc") == f"http://127.0.0.1:{listening.getsockname()[1]}/abc/"
    with pytest.raises(InputError, match="cannot be used"):
        loopback_socket(listening.getsockname()[1])
    listening.close()


def test_tokens_differ_and_are_long():
    tokens = {new_token() for _ in range(50)}
    assert len(tokens) == 50
    assert min(map(len, tokens)) >= 43
