"""Robot Web Services of the emulated controller, over HTTP."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tests.simulation.physics.bench import bench
from tests.waiting import wait_for

AUTH = httpx.DigestAuth("Default User", "robotics")


@pytest.fixture(scope="module")
def cell():
    with bench() as made:
        yield made


@pytest.fixture
def rws(cell):
    cell.call(cell.cell.board.clear)
    with httpx.Client(base_url=cell.description["rws_url"], auth=AUTH, params={"json": "1"}, timeout=30.0) as client:
        yield client
        client.get("/logout")


def field(client, path, name):
    return client.get(path).raise_for_status().json()["_embedded"]["_state"][0][name]


def post(client, path, action, **form):
    return client.post(path, params={"action": action, "json": "1"}, data=form)


def until(client, path, name, value):
    wait_for(lambda: field(client, path, name) == value)


def bring_up(rws):
    assert post(rws, "/rw/panel/ctrlstate", "setctrlstate", **{"ctrl-state": "motoron"}).status_code == 204
    until(rws, "/rw/panel/ctrlstate", "ctrlstate", "motoron")
    assert post(rws, "/rw/rapid/execution", "start", cycle="asis").status_code == 204
    until(rws, "/rw/rapid/execution", "ctrlexecstate", "running")


def test_without_the_password_nothing_is_told(cell):
    url = cell.description["rws_url"] + "/rw/panel/ctrlstate"
    bare = httpx.get(url)
    assert bare.status_code == 401
    assert bare.headers["www-authenticate"].startswith("Digest ")
    assert httpx.get(url, auth=httpx.DigestAuth("Default User", "wrong")).status_code == 401


def test_one_session_cookie_serves_many_requests(rws):
    for _ in range(3):
        rws.get("/rw/panel/ctrlstate").raise_for_status()
    assert len([c for c in rws.cookies.jar if c.name == "ABBCX"]) == 1


def test_a_client_that_drops_its_cookie_runs_out_of_sessions(cell):
    codes = []
    with httpx.Client(base_url=cell.description["rws_url"], auth=AUTH) as client:
        for _ in range(80):
            codes.append(client.get("/rw/panel/opmode").status_code)
            client.cookies.clear()
    assert codes[0] == 200
    assert codes[-1] == 503
    cell.call(cell.cell.gate._sessions.clear)


def test_xhtml_is_the_default_form(cell):
    answer = httpx.get(cell.description["rws_url"] + "/rw/panel/opmode", auth=AUTH)
    assert answer.headers["content-type"].startswith("application/xhtml+xml")
    assert '<span class="opmode">AUTO</span>' in answer.text


def test_stop_answers_before_it_has_stopped(cell, rws):
    bring_up(rws)
    cabinet = cell.cell.cabinet
    quick, cabinet.delays = cabinet.delays, replace(cabinet.delays, program_stop_s=0.5)
    assert post(rws, "/rw/rapid/execution", "stop", stopmode="stop").status_code == 204
    assert field(rws, "/rw/rapid/execution", "ctrlexecstate") == "running"
    until(rws, "/rw/rapid/execution", "ctrlexecstate", "stopped")
    cabinet.delays = quick


def test_rapid_does_not_start_with_motors_off_or_in_manual_mode(cell, rws):
    post(rws, "/rw/panel/ctrlstate", "setctrlstate", **{"ctrl-state": "motoroff"})
    refused = post(rws, "/rw/rapid/execution", "start")
    assert refused.status_code == 403
    assert "motors" in refused.json()["_embedded"]["status"]["msg"]
    cell.faults(robot={"mode": "MANR"})
    assert post(rws, "/rw/panel/ctrlstate", "setctrlstate", **{"ctrl-state": "motoron"}).status_code == 403
    assert field(rws, "/rw/panel/opmode", "opmode") == "MANR"


def test_an_emergency_stop_needs_a_reset_and_motors_on(cell, rws):
    bring_up(rws)
    cell.faults(robot={"emergency_stop": True})
    until(rws, "/rw/panel/ctrlstate", "ctrlstate", "emergencystop")
    assert field(rws, "/rw/rapid/execution", "ctrlexecstate") == "stopped"
    assert post(rws, "/rw/panel/ctrlstate", "setctrlstate", **{"ctrl-state": "motoron"}).status_code == 403
    cell.call(cell.cell.board.clear)
    until(rws, "/rw/panel/ctrlstate", "ctrlstate", "emergencystopreset")
    bring_up(rws)


def test_pose_and_joints_are_those_of_the_arm(rws):
    pose = rws.get("/rw/motionsystem/mechunits/ROB_1/robtarget", params={"json": "1", "wobj": "gap", "tool": "t"})
    state = pose.json()["_embedded"]["_state"][0]
    assert float(state["x"]) == pytest.approx(8.0, abs=1e-3)
    assert float(field(rws, "/rw/motionsystem/mechunits/ROB_1/robtarget", "x")) == pytest.approx(808.0, abs=1e-3)
    assert abs(float(field(rws, "/rw/motionsystem/mechunits/ROB_1/jointtarget", "rax_2"))) < 120.0


def test_signals_log_and_speed_ratio(rws):
    assert post(rws, "/rw/iosystem/signals/Local/DRV_1/doSlipStop", "set", lvalue="1").status_code == 204
    assert field(rws, "/rw/iosystem/signals/Local/DRV_1/doSlipStop", "lvalue") == "1"
    assert post(rws, "/rw/panel/speedratio", "setspeedratio", **{"speed-ratio": "50"}).status_code == 204
    assert field(rws, "/rw/panel/speedratio", "speedratio") == "50"
    post(rws, "/rw/panel/speedratio", "setspeedratio", **{"speed-ratio": "100"})
    assert post(rws, "/rw/panel/speedratio", "setspeedratio", **{"speed-ratio": "nan"}).status_code == 400
    assert post(rws, "/rw/panel/ctrlstate", "setctrlstate", **{"ctrl-state": "motoron"}).status_code == 204
    until(rws, "/rw/panel/ctrlstate", "ctrlstate", "motoron")  # which the log tells
    assert int(field(rws, "/rw/elog/0/?lang=en", "code")) > 0


@pytest.mark.parametrize("path", ["/rw/nothing", "/rw/panel/none", "/rw/iosystem/signals/none"])
def test_what_does_not_exist_answers_404(rws, path):
    answer = rws.get(path)
    assert answer.status_code == 404
    assert "_embedded" in answer.json()


@pytest.mark.parametrize("value", ["14.285", "2", "-1", "nan", ""])
def test_a_digital_signal_takes_bits_only(rws, value):
    assert post(rws, "/rw/iosystem/signals/doSlipStop", "set", lvalue=value).status_code == 400


@pytest.mark.parametrize("value", ["20.1", "-0.1", "nan", "inf", "", "x"])
def test_an_analog_signal_keeps_to_its_range(rws, value):
    assert post(rws, "/rw/iosystem/signals/aoClampForce", "set", lvalue="20").status_code == 204
    assert post(rws, "/rw/iosystem/signals/aoClampForce", "set", lvalue=value).status_code == 400
    assert field(rws, "/rw/iosystem/signals/aoClampForce", "lvalue") == "20"
    assert field(rws, "/rw/iosystem/signals/aoClampForce", "type") == "AO"


def test_system_modules_and_configuration_are_told_in_the_references_words(rws):
    rows = rws.get("/rw/system").json()["_embedded"]["_state"]
    assert [row["_type"] for row in rows] == ["sys-system-li", "sys-option-li", "sys-option-li"]
    modules = rws.get("/rw/rapid/modules", params={"json": "1", "task": "T_ROB1"}).json()["_embedded"]["_state"]
    assert {row["_type"] for row in modules} == {"rap-module-info-li"}
    assert rws.get("/rw/rapid/modules").status_code == 400
    robots = rws.get("/rw/cfg/moc/robot/instances").json()["_embedded"]["_state"]
    assert (robots[0]["_type"], robots[0]["_title"]) == ("cfg-dt-instance-li", "ROB_1")
    assert robots[0]["attrib"][0] == {"_type": "cfg-ia-t-li", "_title": "name", "value": "ROB_1"}
    xhtml = rws.get("/rw/cfg/moc/robot/instances", params={"json": "0"}).text
    assert '<ul><li class="cfg-ia-t-li" title="name"><span class="value">ROB_1</span></li>' in xhtml
    assert rws.get("/rw/cfg/none/robot/instances").status_code == 404


def test_external_axes_have_the_names_that_clients_of_either_form_read(rws):
    page = rws.get("/rw/motionsystem/mechunits/ROB_1/robtarget", params={"json": "0"}).text
    assert '<span class="eax_a">9E+09</span>' in page
    assert field(rws, "/rw/motionsystem/mechunits/ROB_1/robtarget", "eaxf") == "9E+09"
    assert field(rws, "/rw/motionsystem/mechunits/ROB_1/jointtarget", "eax_f") == "9E+09"


def test_files_are_kept_listed_and_deleted(rws):
    assert rws.put("/fileservice/$home/a.mod", content=b"MODULE a").status_code == 201
    assert rws.put("/fileservice/$home/a.mod", content=b"MODULE b").status_code == 200
    assert rws.get("/fileservice/$home/a.mod").content == b"MODULE b"
    assert field(rws, "/fileservice/$home", "_title") == "a.mod"
    assert rws.put("/fileservice/$home/large", content=bytes(2 << 20)).status_code == 400
    assert rws.delete("/fileservice/$home/a.mod").status_code == 204
    assert rws.delete("/fileservice/$home/a.mod").status_code == 404


def test_a_subscription_can_be_given_back(rws):
    made = rws.post("/subscription", data={"resources": "1", "1": "/rw/panel/opmode"})
    number = made.headers["location"].rsplit("/", 1)[1]
    headers = {"Cookie": f"ABBCX={rws.cookies['ABBCX']}"}
    with connect(made.headers["location"], subprotocols=["robapi2_subscription"], additional_headers=headers) as socket:
        assert rws.delete(f"/subscription/{number}/rw/panel/none").status_code == 404
        assert rws.delete(f"/subscription/{number}/rw/panel/opmode").status_code == 200
        with pytest.raises(ConnectionClosed):
            socket.recv(timeout=30.0)
    assert rws.delete(f"/subscription/{number}").status_code == 404
    made = rws.post("/subscription", data={"resources": "1", "1": "/rw/panel/opmode"})
    assert rws.delete(f"/subscription/{made.headers['location'].rsplit('/', 1)[1]}").status_code == 200


OF_THE_CLIENT = {"request_rmmp", "poll_rmmp"}  # both join the controller's address to one that is whole already


def test_every_method_of_the_stock_rws_client_does_what_it_says(cell):
    cell.call(cell.cell.board.clear)
    cell.call(cell.cell.cabinet.request_stop)
    cell.wait(lambda: not cell.cell.cabinet.running)
    joints = "[[0,0,0,0,0,0],[0,0,0,0,0,0]]"
    cell.cell.cabinet.symbols |= {"peerNumber": "0", "peerNumbers": "[0]", "peerJoints": joints, "peerPath": "[]"}
    command = [sys.executable, str(Path(__file__).with_name("peer_abb_robot_client.py")), cell.description["rws_url"]]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert {name: error for name, error in report["errors"].items() if error and name not in OF_THE_CLIENT} == {}
    assert report["never_called"] == []


def test_faults_refuse_delay_reset_and_garble(cell, rws):
    cell.faults(rws={"refuse_next": 1})
    assert rws.get("/rw/panel/opmode").status_code == 503
    cell.faults(rws={"reset_next": 1})
    with pytest.raises(httpx.TransportError):
        rws.get("/rw/panel/opmode")
    cell.faults(rws={"delay_ms": 200.0})
    begin = time.monotonic()
    rws.get("/rw/panel/opmode")
    assert time.monotonic() - begin > 0.19
    cell.faults(rws={"delay_ms": 0.0, "garbage_next": 1})
    with pytest.raises(ValueError):
        rws.get("/rw/panel/opmode").json()


def test_an_ignored_stop_keeps_running(cell, rws):
    bring_up(rws)
    cell.faults(rws={"stop_ignored": True})
    assert post(rws, "/rw/rapid/execution", "stop").status_code == 204
    time.sleep(0.3)
    assert field(rws, "/rw/rapid/execution", "ctrlexecstate") == "running"


def test_a_subscription_tells_changes_over_a_websocket(cell, rws):
    form = {"resources": ["1", "2"], "1": "/rw/panel/opmode", "1-p": "1", "2": "/rw/elog/0", "2-p": "0"}
    made = rws.post("/subscription", data=form)
    assert made.status_code == 201
    headers = {"Cookie": f"ABBCX={rws.cookies['ABBCX']}"}
    with connect(made.headers["location"], subprotocols=["robapi2_subscription"], additional_headers=headers) as socket:
        cell.faults(robot={"mode": "MANR"})
        assert '<a href="/rw/panel/opmode" rel="self"/><span class="opmode">MANR<' in socket.recv(timeout=30.0)
    cell.call(cell.cell.board.clear)


def test_a_subscription_of_nothing_or_of_a_stranger_is_refused(cell, rws):
    assert rws.post("/subscription", data={}).status_code == 400
    assert rws.post("/subscription", data={"resources": "1", "1": "/rw/none"}).status_code == 404
    made = rws.post("/subscription", data={"resources": "1", "1": "/rw/panel/opmode"})
    with pytest.raises(InvalidStatus):
        connect(made.headers["location"])
