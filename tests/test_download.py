"""Downloads from a server that lies, stalls and vanishes; archives that reach out."""

import hashlib
import http.server
import io
import shutil
import ssl
import subprocess
import threading
import urllib.request
import zipfile

import h5py
import numpy as np
import pytest

from corrmat.cli import main
from corrmat.data import modelnet40
from corrmat.data.download import fetch, unzip
from corrmat.errors import CorrmatError

CONTENT = np.random.default_rng(0).bytes(300_000)
DIGEST = hashlib.sha256(CONTENT).hexdigest()


class Server:
    """Serves CONTENT on the loopback; `behave` says how each request in turn is answered."""

    def __init__(self):
        self.behave, self.ranges, self.content = [], [], CONTENT
        self.release = threading.Event()
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                reply = outer.behave.pop(0) if outer.behave else "well"
                wanted = self.headers.get("Range")
                outer.ranges.append(wanted)
                content, status = outer.content, 200
                if reply == "redirect":
                    self.send_response(302)
                    self.send_header("Location", outer.url)
                    self.end_headers()
                    return
                if reply in ("404", "503"):
                    self.send_error(int(reply))
                    return
                if reply == "416" or wanted and int(wanted[6:-1]) >= len(content):
                    self.send_error(416)
                    return
                if wanted and reply != "no ranges":
                    content, status = content[int(wanted[6:-1]) :], 206
                if reply == "wrong":
                    content = bytes(len(content))
                self.send_response(status)
                self.send_header("Content-Length", str(len(content)))
                self.send_header("ETag", '"one"')
                self.end_headers()
                part = content[: len(content) // 2] if reply in ("cut", "stall") else content
                self.wfile.write(part)
                self.wfile.flush()
                if reply == "stall":
                    outer.release.wait(20)
                self.close_connection = True

            def log_message(self, *words):
                pass

        self.http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_port}/data.zip"
        threading.Thread(target=self.http.serve_forever, daemon=True).start()


@pytest.fixture
def server():
    server = Server()
    yield server
    server.release.set()
    server.http.shutdown()
    server.http.server_close()


@pytest.mark.parametrize(
    "behave", [[], ["redirect"], ["cut"], ["cut", "cut"], ["cut", "no ranges"], ["stall"]]
)
def test_the_whole_file_arrives_in_the_end(behave, server, tmp_path):
    server.behave = list(behave)
    path = tmp_path / "data.zip"
    fetch([server.url], path, DIGEST, timeout=0.5 if "stall" in behave else 30)
    assert path.read_bytes() == CONTENT
    assert [p.name for p in tmp_path.iterdir()] == ["data.zip"]


def test_a_second_run_goes_on_where_the_first_was_cut(server, tmp_path):
    path = tmp_path / "data.zip"
    server.behave = ["cut", "404"]
    with pytest.raises(CorrmatError, match="cut short after 150000 of 300000 bytes"):
        fetch([server.url], path, DIGEST)
    assert not path.exists()
    fetch([server.url], path, DIGEST)
    assert server.ranges[-1] == "bytes=150000-"
    assert path.read_bytes() == CONTENT


def test_a_run_killed_between_the_last_byte_and_the_move_starts_again(server, tmp_path):
    path = tmp_path / "data.zip"
    server.behave = ["cut", "404"]
    with pytest.raises(CorrmatError, match="cut short"):
        fetch([server.url], path, DIGEST)
    (tmp_path / "data.zip.partial").write_bytes(CONTENT)
    fetch([server.url], path, DIGEST)
    assert server.ranges[-2:] == ["bytes=300000-", None]
    assert path.read_bytes() == CONTENT


def test_an_address_that_is_none_is_named(tmp_path):
    with pytest.raises(CorrmatError, match="example.org/data.zip: unknown url type"):
        fetch(["example.org/data.zip"], tmp_path / "data.zip")


@pytest.mark.parametrize(
    ("behave", "message"),
    [
        (["404"], "HTTP 404"),
        (["503"], "HTTP 503"),
        (["wrong"], "its SHA-256 is .*, not "),
        (["cut"] * 3, "cut short"),
        (["stall"] * 3, "timed out"),
    ],
)
def test_a_server_that_never_gives_the_file_is_named_with_its_fault(
    behave, message, server, tmp_path
):
    server.behave = list(behave)
    patience = 0.3 if "stall" in behave else 30
    with pytest.raises(CorrmatError, match=f"cannot fetch data.zip: {server.url}: {message}"):
        fetch([server.url], tmp_path / "data.zip", DIGEST, timeout=patience)
    assert not (tmp_path / "data.zip").exists()


def test_the_next_mirror_is_tried_and_never_mends_the_last_ones_file(server, tmp_path):
    other = Server()
    server.behave = ["cut"] * 3
    fetch([server.url, "http://127.0.0.1:9/none.zip", other.url], tmp_path / "data.zip", DIGEST)
    assert other.ranges == [None]
    assert (tmp_path / "data.zip").read_bytes() == CONTENT
    other.http.shutdown()
    other.http.server_close()


def test_the_first_download_is_trusted_and_later_ones_must_equal_it(server, tmp_path, capsys):
    path = tmp_path / "data.zip"
    fetch([server.url], path)
    assert DIGEST in capsys.readouterr().out
    assert DIGEST in (tmp_path / "data.zip.sha256").read_text()
    path.unlink()
    server.content = CONTENT[::-1]
    with pytest.raises(CorrmatError, match=f"not {DIGEST}"):
        fetch([server.url], path)


def test_a_server_that_always_says_that_nothing_is_left_is_named(server, tmp_path):
    server.behave = ["416"] * 9
    with pytest.raises(CorrmatError, match="HTTP 416"):
        fetch([server.url], tmp_path / "data.zip")


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl at hand")
def test_certificates_are_checked(server, tmp_path):
    """A server that signs for itself serves the whole file, and gets no say."""
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    words = [
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-days",
        "1",
        "-subj",
        "/CN=127.0.0.1",
    ]
    words += ["-addext", "subjectAltName=IP:127.0.0.1", "-keyout", key, "-out", certificate]
    subprocess.run(["openssl", *words], check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    server.http.socket = context.wrap_socket(server.http.socket, server_side=True)
    url = server.url.replace("http:", "https:")
    with pytest.raises(CorrmatError, match="CERTIFICATE_VERIFY_FAILED"):
        fetch([url], tmp_path / "data.zip", timeout=5)
    assert not (tmp_path / "data.zip").exists()
    trusting = ssl.create_default_context(cafile=certificate)
    with urllib.request.urlopen(url, timeout=5, context=trusting) as answer:
        assert answer.read() == CONTENT  # it was the certificate, and nothing else


def archive(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


@pytest.mark.parametrize("name", ["../out.txt", "/etc/out.txt", "set/../../out.txt"])
def test_an_archive_that_reaches_out_is_refused(name, tmp_path):
    path = archive(tmp_path / "a.zip", {"set/in.txt": "in", name: "out"})
    with pytest.raises(CorrmatError, match="leads out of the folder"):
        unzip(path, tmp_path, "set")
    assert [p.name for p in tmp_path.iterdir()] == ["a.zip"]


def test_links_damage_and_other_archives_are_refused(tmp_path):
    link = zipfile.ZipInfo("set/link")
    link.external_attr = 0o120777 << 16
    path = archive(tmp_path / "a.zip", {"set/in.txt": "in"})
    with zipfile.ZipFile(path, "a") as file:
        file.writestr(link, "/etc/passwd")
    with pytest.raises(CorrmatError, match="is a link"):
        unzip(path, tmp_path, "set")
    whole = archive(tmp_path / "b.zip", {"set/in.txt": CONTENT.hex()}).read_bytes()
    for at in (60, 1000, len(whole) // 2, -30):  # of its member's packed bytes, of its directory
        corrupted = bytearray(whole)
        corrupted[at : at + 4] = bytes(255 - byte for byte in corrupted[at : at + 4])
        (tmp_path / "b.zip").write_bytes(corrupted)
        with pytest.raises(CorrmatError, match="damaged|no whole zip|leads out|does not hold"):
            unzip(tmp_path / "b.zip", tmp_path, "set")
    named = archive(tmp_path / "b.zip", {"set/ä.txt": "in"}).read_bytes()
    (tmp_path / "b.zip").write_bytes(named.replace("ä".encode(), b"\xff\xff"))
    with pytest.raises(CorrmatError, match="no whole zip"):
        unzip(tmp_path / "b.zip", tmp_path, "set")
    encrypted = bytearray(whole)
    for start in (whole.find(b"PK\x03\x04") + 6, whole.rfind(b"PK\x01\x02") + 8):
        encrypted[start] |= 1  # the flag; nobody has the key
    (tmp_path / "b.zip").write_bytes(encrypted)
    with pytest.raises(CorrmatError, match="no whole zip"):
        unzip(tmp_path / "b.zip", tmp_path, "set")
    (tmp_path / "c.zip").write_bytes(whole[:50])
    with pytest.raises(CorrmatError, match="no whole zip"):
        unzip(tmp_path / "c.zip", tmp_path, "set")
    archive(tmp_path / "d.zip", {"other/in.txt": "in"})
    with pytest.raises(CorrmatError, match="does not hold the folder set"):
        unzip(tmp_path / "d.zip", tmp_path, "set")
    assert not (tmp_path / "set").exists()


def test_the_command_fetches_unpacks_and_reads_modelnet40(server, tmp_path, capsys):
    shapes = io.BytesIO()
    with h5py.File(shapes, "w") as file:
        points = np.random.default_rng(0).normal(size=(2, 64, 3)).astype(np.float32)
        file["data"], file["normal"], file["label"] = points, points, np.zeros((2, 1), np.uint8)
    name = modelnet40.FOLDER
    members = {f"{name}/shape_names.txt": "airplane\n"}
    for split in ("train", "test"):
        members[f"{name}/ply_data_{split}0.h5"] = shapes.getvalue()
        members[f"{name}/{split}_files.txt"] = f"data/{name}/ply_data_{split}0.h5\n"
    server.content = archive(tmp_path / "made.zip", members).read_bytes()
    root = tmp_path / "root"
    words = ["data", "modelnet40", "--root", str(root), "--mirror", server.url]
    assert main(words) == 0
    assert "complete; use it with" in capsys.readouterr().out
    assert len(modelnet40.load("test", root=root)) == 2
    asked = len(server.ranges)
    assert main(words) == 0  # it is there
    assert len(server.ranges) == asked
    assert main(["data", "modelnet40"]) == 2
    assert "--root folder" in capsys.readouterr().err
