"""Where work is done: what is accepted, and what is refused with which remedy."""

import os
from typing import Any

import pytest

from hil.engine.settings import EngineSettings, host_and_port
from plant.errors import InputError

TLS = {"tls_ca": "ca.pem", "tls_cert": "machine.pem", "tls_key": "machine.key"}


def test_the_work_is_for_all_processors_and_nobody_else() -> None:
    settings = EngineSettings()
    assert settings.processes == len(os.sched_getaffinity(0))
    assert (settings.others_join, settings.tls) == (False, False)
    assert host_and_port(settings.listen)[0] == host_and_port(settings.dashboard)[0] == "127.0.0.1"


def test_one_worker_is_this_process_unless_others_join() -> None:
    assert EngineSettings(workers=1).alone
    assert not EngineSettings(workers=1, listen="127.0.0.1:8786").alone
    assert not EngineSettings(workers=0, listen="127.0.0.1:8786").alone
    assert not EngineSettings(scheduler="tcp://127.0.0.1:8786").alone


def test_whoever_asks_for_a_page_or_certificates_gets_them_with_one_worker_too() -> None:
    assert not EngineSettings(workers=1, dashboard="127.0.0.1:0").alone
    assert not EngineSettings(workers=1, **TLS).alone


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]"])
def test_this_machine_needs_no_certificate(host: str) -> None:
    assert not EngineSettings(listen=f"{host}:8786", dashboard=f"{host}:0").tls


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"workers": -1}, "-1 workers are asked for; there can be 0 to 1024"),
        ({"workers": 1025}, "1025 workers"),
        ({"workers": 0}, "say where, with --listen HOST:PORT"),
        ({"tls_ca": "ca.pem"}, "three files: --tls-ca, --tls-cert and --tls-key"),
        ({"listen": "0.0.0.0:8786"}, "--listen 0.0.0.0:8786 can be reached from other machines, so it needs TLS"),
        ({"listen": "192.168.0.2:8786"}, "needs TLS"),
        ({"dashboard": "[::]:8787"}, r"--dashboard \[::\]:8787 can be reached from other machines"),
        ({"listen": "8786"}, "'8786' is no address such as"),
        ({"listen": "127.0.0.1:99999"}, "no address such as"),
        ({"dashboard": "127.0.0.1:x"}, "no address such as"),
        ({"scheduler": "10.0.0.1:8786"}, "no address of a scheduler such as tcp://127.0.0.1:8786"),
        ({"scheduler": "tcp://10.0.0.1"}, "no address such as"),
        ({"scheduler": "tls://10.0.0.1:8786"}, "go with tls://HOST:PORT, and only with it; here is tls://10.0.0.1:8786"),
        ({"scheduler": "tcp://10.0.0.1:8786"} | TLS, "here is tcp://10.0.0.1:8786"),
        ({"scheduler": "tcp://10.0.0.1:8786", "workers": 2}, "the scheduler has workers of its own"),
        ({"scheduler": "tcp://10.0.0.1:8786", "listen": "127.0.0.1:1"}, "leave out these, or --scheduler"),
        ({"scheduler": "tcp://10.0.0.1:8786", "dashboard": "127.0.0.1:1"}, "leave out these, or --scheduler"),
    ],
)
def test_what_cannot_be_is_refused_with_the_remedy(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        EngineSettings(**values)


@pytest.mark.parametrize(
    "values", [{"listen": "0.0.0.0:8786"}, {"dashboard": "10.0.0.1:0"}, {"scheduler": "tls://10.0.0.1:8786"}]
)
def test_with_tls_other_machines_may_connect(values: dict[str, Any]) -> None:
    assert EngineSettings(**values, **TLS).tls
