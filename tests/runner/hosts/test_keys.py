"""Keys: made once, private from the first byte, never overwritten, and checked before they are used."""

import datetime
from pathlib import Path

import pytest
from cryptography import x509

import runner.hosts.keys
from runner.cli.main import main
from runner.contract import Refused
from runner.graph.placement import Host
from runner.hosts.keys import add_keys, credentials, make_keys
from tests.runner.common.machines import HOSTS

PAIR = [Host("head", "10.0.0.1"), Host("arm", "lab.local")]


def test_every_host_gets_a_folder_of_its_own_that_nobody_else_reads(tmp_path: Path):
    make_keys(tmp_path / "keys", PAIR)
    files = [path for path in (tmp_path / "keys").rglob("*") if path.is_file()]
    assert {str(path.relative_to(tmp_path / "keys")) for path in files} == {
        *("ca.pem", "ca-key.pem"),
        *(f"{name}/{file}" for name in ("head", "arm", "reader") for file in ("ca.pem", "cert.pem", "key.pem")),
    }
    assert {path.stat().st_mode & 0o777 for path in files} == {0o600}
    assert (tmp_path / "keys" / "head").stat().st_mode & 0o777 == 0o700


def test_a_certificate_names_its_host_and_address(tmp_path: Path):
    make_keys(tmp_path, PAIR)
    found = {
        name: x509.load_pem_x509_certificate((tmp_path / name / "cert.pem").read_bytes()) for name in ("head", "arm")
    }
    names = {
        name: one.extensions.get_extension_for_class(x509.SubjectAlternativeName).value for name, one in found.items()
    }
    assert [str(ip) for ip in names["head"].get_values_for_type(x509.IPAddress)] == ["10.0.0.1"]
    assert names["arm"].get_values_for_type(x509.DNSName) == ["arm", "lab.local"]
    assert found["arm"].subject.rfc4514_string() == "CN=arm"
    found["arm"].verify_directly_issued_by(x509.load_pem_x509_certificate((tmp_path / "ca.pem").read_bytes()))


def test_keys_are_not_overwritten(tmp_path: Path):
    make_keys(tmp_path, PAIR)
    before = (tmp_path / "head" / "key.pem").read_bytes()
    with pytest.raises(Refused, match="there are keys already and they are not overwritten"):
        make_keys(tmp_path, PAIR)
    with pytest.raises(Refused, match="head: is there already and is not overwritten"):
        add_keys(tmp_path, PAIR)
    assert (tmp_path / "head" / "key.pem").read_bytes() == before
    add_keys(tmp_path, [Host("leg", "10.0.0.3")])
    assert credentials(tmp_path, "leg").key == str(tmp_path / "leg" / "key.pem")


def test_only_good_credentials_are_used(tmp_path: Path):
    make_keys(tmp_path, PAIR)
    with pytest.raises(Refused, match=r"leg/cert\.pem: No such file or directory; make keys with `runner keys init`"):
        credentials(tmp_path, "leg")
    (tmp_path / "head" / "key.pem").chmod(0o640)
    with pytest.raises(Refused, match="others on this machine can read it; type: chmod 600"):
        credentials(tmp_path, "head")
    (tmp_path / "arm").rename(tmp_path / "leg")
    with pytest.raises(Refused, match="is the certificate of 'arm'; valid: that of 'leg'"):
        credentials(tmp_path, "leg")
    (tmp_path / "leg" / "cert.pem").write_bytes((tmp_path / "head" / "cert.pem").read_bytes())
    (tmp_path / "leg").rename(tmp_path / "head2")
    (tmp_path / "head").rename(tmp_path / "head1")
    (tmp_path / "head2").rename(tmp_path / "head")
    with pytest.raises(Refused, match="is not the key of the certificate beside it"):
        credentials(tmp_path, "head")


def test_a_certificate_that_has_ended_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(runner.hosts.keys, "HOST_DAYS", -0.5)
    make_keys(tmp_path, PAIR)
    day = (datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=0.5)).date()
    with pytest.raises(Refused, match=f"ended on {day}; remove .* and make another: runner keys add"):
        credentials(tmp_path, "head")


def test_the_command_says_what_goes_where(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    graph = tmp_path / "graph.yaml"
    graph.write_text(HOSTS.read_text().replace("worker1: 127.0.0.1", "worker1: 10.0.0.2"))
    assert main(["keys", "init", str(graph)]) == 0
    said = capsys.readouterr().out
    assert f"{tmp_path}/keys: an authority, and certificates for head, worker1, worker2" in said
    assert f"{tmp_path}/keys/worker1: copy this folder to worker1 (10.0.0.2)" in said
    assert main(["keys", "init", str(graph)]) == 2
    assert main(["keys", "add", "--keys", str(tmp_path / "keys"), "worker3=10.0.0.4"]) == 0
    assert (tmp_path / "keys" / "worker3" / "key.pem").exists()
    assert main(["keys", "add", "worker4"]) == 2
