"""Gaia's archive, with a stand-in that answers TAP queries on this machine."""

import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from urllib.parse import parse_qs, urlparse

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io.votable import from_table
from astropy.table import Table

from wpdc_gwcs import calibrate, simulate
from wpdc_gwcs.catalogs import GaiaArchive, Region, gaia, read_catalog
from wpdc_gwcs.exceptions import CatalogError

pytest.importorskip("pyvo")
pytest.importorskip("astropy_healpix")

JOB = """<?xml version="1.0"?>
<uws:job xmlns:uws="http://www.ivoa.net/xml/UWS/v1.0" xmlns:xlink="http://www.w3.org/1999/xlink">
<uws:jobId>{job}</uws:jobId><uws:phase>{phase}</uws:phase><uws:executionDuration>0
</uws:executionDuration><uws:parameters/>{results}{error}</uws:job>"""
RESULTS = '<uws:results><uws:result id="result" xlink:href="{url}"/></uws:results>'
ERROR = """<uws:errorSummary type="fatal" hasDetail="false"><uws:message>{text}</uws:message>
</uws:errorSummary>"""


def gaia_like(n=800, center=(120.0, 30.0), spread=1.2, seed=0):
    """Stars with the columns of gaia_source, and some that nobody asks for."""
    rng = np.random.default_rng(seed)
    table = Table({name: rng.uniform(0, 1, n) for name in gaia._COLUMNS})
    table["source_id"] = np.arange(n) + 10**17
    table["ra"] = (
        center[0] + rng.uniform(-spread, spread, n) / np.cos(np.radians(center[1]))
    ) % 360
    table["dec"] = center[1] + rng.uniform(-spread, spread, n)
    table["ref_epoch"], table["ruwe"] = 2016.0, 1.0
    table["phot_g_mean_mag"] = rng.uniform(10, 21, n)
    table["designation"] = "not asked for"
    return table


class Service(ThreadingHTTPServer):
    """Jobs as TAP has them: created, started, asked for, their results fetched, deleted."""

    daemon_threads = True

    def __init__(self, table, **manners):
        super().__init__(("127.0.0.1", 0), Handler)
        self.table, self.manners = table, manners
        self.jobs, self.queries, self.failures = {}, [], manners.get("failures", 0)
        self.url = f"http://127.0.0.1:{self.server_address[1]}/tap"

    def answer(self, query):
        """What the query asks for: columns, circle, limit."""
        found = re.fullmatch(
            r"SELECT (.+) FROM gaiadr3.gaia_source WHERE 1 = CONTAINS\(POINT\('ICRS', ra, dec\), "
            r"CIRCLE\('ICRS', (.+), (.+), (.+)\)\) AND phot_g_mean_mag <= (.+)",
            query,
        )
        columns, *numbers = found.groups()
        ra, dec, radius, limit = map(float, numbers)
        sky = SkyCoord(self.table["ra"], self.table["dec"], unit="deg")
        near = sky.separation(SkyCoord(ra, dec, unit="deg")).deg <= radius
        rows = self.table[near & (self.table["phot_g_mean_mag"] <= limit)]
        rows = rows[columns.split(", ")]
        if "lacks" in self.manners:
            rows.remove_column(self.manners["lacks"])
        text = BytesIO()
        from_table(rows).to_xml(text)
        status = "OVERFLOW" if self.manners.get("overflow") else "OK"
        return text.getvalue().replace(
            b'type="results">',
            f'type="results"><INFO name="QUERY_STATUS" value="{status}"/>'.encode(),
            1,
        )


class Handler(BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def send(self, code, body=b"", **headers):
        self.send_response(code)
        for key, value in headers.items():
            self.send_header(key.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def fields(self):
        return parse_qs(self.rfile.read(int(self.headers.get("Content-Length", 0))).decode())

    def do_POST(self):
        service, fields = self.server, self.fields()
        parts = urlparse(self.path).path.strip("/").split("/")
        if service.failures > 0:
            service.failures -= 1
            self.send(503, b"busy")
        elif parts[-1] == "sync" and service.manners.get("sync"):
            service.queries.append(fields["QUERY"][0])
            self.send(200, service.answer(fields["QUERY"][0]), Content_Type="text/xml")
        elif parts[-1] == "async" and not service.manners.get("sync"):
            number = str(len(service.jobs) + 1)
            service.jobs[number] = ["PENDING", fields["QUERY"][0]]
            service.queries.append(fields["QUERY"][0])
            self.send(303, Location=f"{service.url}/async/{number}")
        elif parts[-1] == "phase":
            service.jobs[parts[-2]][0] = "ERROR" if "refuse" in service.manners else "COMPLETED"
            self.send(303, Location=f"{service.url}/async/{parts[-2]}")
        else:
            self.send(404)

    def do_GET(self):
        service = self.server
        parts = urlparse(self.path).path.strip("/").split("/")
        if parts[-1] == "result":
            self.send(200, service.answer(service.jobs[parts[-3]][1]), Content_Type="text/xml")
        elif parts[-1] in service.jobs:
            phase = service.jobs[parts[-1]][0]
            error = ERROR.format(text=service.manners["refuse"]) if phase == "ERROR" else ""
            results = RESULTS.format(url=f"{service.url}/async/{parts[-1]}/results/result")
            body = JOB.format(job=parts[-1], phase=phase, results=results, error=error)
            self.send(200, body.encode(), Content_Type="text/xml")
        else:
            self.send(404)

    def do_DELETE(self):
        self.send(303, Location=f"{self.server.url}/async")


@contextmanager
def standing_in(table, **manners):
    with Service(table, **manners) as service:
        thread = threading.Thread(target=service.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield service
        service.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    monkeypatch.setattr(gaia, "_WAITS", (0.0, 0.0, 0.0))
    monkeypatch.delenv("WPDC_GWCS_TAP_URL", raising=False)
    monkeypatch.delenv("WPDC_GWCS_CACHE", raising=False)


REGION = Region(ra=[120.0, 120.9], dec=[30.0, 30.2], radius=[0.4, 0.3])


def inside(table, region=REGION):
    sky = SkyCoord(table["ra"], table["dec"], unit="deg")
    return np.any(
        [
            sky.separation(SkyCoord(*center, unit="deg")).deg <= radius
            for *center, radius in zip(region.ra, region.dec, region.radius, strict=True)
        ],
        axis=0,
    )


@pytest.mark.parametrize("manners", [{}, {"sync": True}, {"failures": 2}])
def test_stars_of_a_region_come_once(tmp_path, manners):
    table = gaia_like()
    with standing_in(table, **manners) as service:
        archive = GaiaArchive(url=service.url, cache=tmp_path)
        found = read_catalog(archive, region=REGION)
        asked = len(service.queries)
        again = read_catalog(archive, region=REGION)
        assert len(service.queries) == asked > 0
        assert "designation" not in service.queries[0]
        # A part of what is there needs no query, brighter stars neither.
        bright = GaiaArchive(url=service.url, cache=tmp_path, max_mag=15.0)
        few = read_catalog(bright, region=REGION)
        assert len(service.queries) == asked
        faint = GaiaArchive(url=service.url, cache=tmp_path, max_mag=20.9)
        assert len(read_catalog(faint, region=REGION)) > len(found)
        assert len(service.queries) == 2 * asked
    truth = table[inside(table) & (table["phot_g_mean_mag"] <= 20.5)]
    assert set(truth["source_id"]) <= set(found["source_id"])
    assert len(found) < 1.2 * len(truth)
    assert len(set(found["source_id"])) == len(found)
    order = np.argsort(found["source_id"])
    expected = table[np.isin(table["source_id"], found["source_id"])]
    for name in ("ra", "dec", "pmra", "ra_pmdec_corr", "radial_velocity", "ruwe"):
        np.testing.assert_array_equal(found[name][order], expected[name])
    assert np.all(found["source_id"] == again["source_id"])
    assert few["phot_g_mean_mag"].max() <= 15.0
    assert set(few["source_id"]) == set(found["source_id"][found["phot_g_mean_mag"] <= 15.0])


@pytest.mark.parametrize("center", [(0.1, 0.0), (359.9, 89.6), (200.0, -89.9), (315.0, 41.8)])
def test_regions_across_the_seams_of_the_sky(tmp_path, center):
    region = Region(*center, 0.5)
    rng = np.random.default_rng(2)
    n = 600
    table = gaia_like(n, center=(center[0], 0.0))
    around = SkyCoord(*center, unit="deg").directional_offset_by(
        rng.uniform(0, 360, n) * SkyCoord(0, 0, unit="deg").ra.unit,
        rng.uniform(0, 1.0, n) * SkyCoord(0, 0, unit="deg").ra.unit,
    )
    table["ra"], table["dec"] = around.ra.deg, around.dec.deg
    table["phot_g_mean_mag"] = 15.0
    with standing_in(table) as service:
        found = read_catalog(GaiaArchive(url=service.url, cache=tmp_path), region=region)
    assert set(found["source_id"]) == set(table["source_id"][inside(table, region)])


def test_what_is_kept_needs_no_network_and_what_is_broken_is_asked_again(tmp_path):
    with standing_in(gaia_like()) as service:
        archive = GaiaArchive(url=service.url, cache=tmp_path)
        found = read_catalog(archive, region=REGION)
        kept = sorted(tmp_path.rglob("*.fits"))
        kept[0].write_bytes(b"SIMPLE  = broken")
        before = len(service.queries)
        assert len(read_catalog(archive, region=REGION)) == len(found)
        assert len(service.queries) == before + 1
    assert len(read_catalog(archive, region=REGION)) == len(found)
    assert not list(tmp_path.rglob("*.tmp"))
    with pytest.raises(CatalogError) as problem:
        read_catalog(archive, region=Region(200, 0, 0.1))
    message = str(problem.value)
    assert "did not answer in 3 tries" in message
    assert "wpdc catalog prepare gaia" in message
    assert "--tap-url" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("manners", "message"),
    [
        ({"refuse": "quota of anonymous users"}, "refuses the query: .*quota of anonymous"),
        ({"overflow": True}, "does not return all stars of a cell"),
        ({"lacks": "pmra"}, "does not return the columns pmra"),
        ({"failures": 99}, "did not answer in 3 tries: .*503"),
    ],
)
def test_services_that_do_not_serve(tmp_path, manners, message):
    with standing_in(gaia_like(), **manners) as service:
        with pytest.raises(CatalogError, match=message):
            read_catalog(GaiaArchive(url=service.url, cache=tmp_path), region=REGION)
        assert len(service.queries) <= 1
    assert not list(tmp_path.rglob("*.fits"))


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, caplog):
    (tmp_path / "gaia").write_text("a file, no folder")
    with standing_in(gaia_like()) as service:
        found = read_catalog(GaiaArchive(url=service.url, cache=tmp_path), region=REGION)
    assert len(found) > 30
    assert "cannot be cached" in caplog.text


def test_environment_names_service_and_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("WPDC_GWCS_TAP_URL", "http://127.0.0.1:9/tap/")
    monkeypatch.setenv("WPDC_GWCS_CACHE", str(tmp_path))
    archive = GaiaArchive()
    assert archive.url == "http://127.0.0.1:9/tap"
    assert tmp_path in archive._folder().parents
    for wrong in ({"url": "gaia.aip.de"}, {"max_mag": np.nan}, {"table": "a; DROP TABLE b"}):
        with pytest.raises(CatalogError, match="must"):
            GaiaArchive(**wrong)


def test_packages_that_are_missing(tmp_path, monkeypatch):
    from wpdc_gwcs import extras

    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(CatalogError, match=r"pyvo and astropy_healpix.*wpdc_gwcs\[gaia\]"):
        read_catalog(GaiaArchive(cache=tmp_path), region=REGION)


def test_frames_are_solved_from_the_archive(tmp_path, monkeypatch):
    simulation = simulate(2, image_shape=(512, 512), density=25, seed=5)
    reference = Table(simulation.reference)
    table = gaia_like(len(reference))
    for name in set(table.colnames) & set(reference.colnames):
        table[name] = np.asarray(reference[name])
    with standing_in(table) as service:
        monkeypatch.setenv("WPDC_GWCS_TAP_URL", service.url)
        monkeypatch.setenv("WPDC_GWCS_CACHE", str(tmp_path))
        run = calibrate([e.frame() for e in simulation.exposures], "gaia")
    assert not run.failures
    x, y, dx, dy = simulation.exposures[0].wcs_error(run.calibrations[0].wcs)
    assert np.sqrt(np.mean(dx**2 + dy**2)) < 0.05
