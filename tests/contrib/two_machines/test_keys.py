"""Keys of encrypted links: made private, read only where nobody else could have read or changed them."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from io import StringIO
from pathlib import Path

import pytest
import zmq
import zmq.auth
from rich.console import Console

from contrib.two_machines import keys as curve_keys
from contrib.two_machines.keys import generate, is_loopback, load_allowed, load_own, load_public

Spoil = Callable[[Path], object]


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """A folder of ours with the pair `car`; its parent is as pytest makes it, 0700."""
    folder = tmp_path / "keys"
    generate("car", folder)
    return folder


@pytest.fixture
def allowed(tmp_path: Path) -> Path:
    """A folder with the public keys of two peers."""
    folder = tmp_path / "allowed"
    folder.mkdir(mode=0o700)
    for name in ("desk", "lab"):
        public, _ = generate(name, tmp_path / "theirs")
        (folder / public.name).write_bytes(public.read_bytes())
        (folder / public.name).chmod(0o644)
    return folder


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_pair_is_a_certificate_of_zmq_auth_with_the_modes_of_a_key(keys: Path) -> None:
    public_path, secret_path = keys / "car.key", keys / "car.key_secret"
    assert (mode_of(keys), mode_of(public_path), mode_of(secret_path)) == (0o700, 0o644, 0o600)
    pair = load_own(secret_path)
    assert zmq.auth.load_certificate(secret_path) == (pair.public, pair.secret)
    assert zmq.auth.load_certificate(public_path) == (pair.public, None)
    assert load_public(public_path) == pair.public == zmq.curve_public(pair.secret)


def test_certificates_of_zmq_auth_are_read(tmp_path: Path) -> None:
    public, secret = map(Path, zmq.auth.create_certificates(tmp_path, "peer", {"site": "lab"}))
    secret.chmod(0o600)
    public.chmod(0o644)
    assert load_own(secret).public == load_public(public)


@pytest.mark.parametrize("umask", [0o000, 0o277])
def test_modes_do_not_depend_on_the_umask(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        public, secret = generate("car", tmp_path)
    finally:
        os.umask(before)
    assert (mode_of(public), mode_of(secret)) == (0o644, 0o600)


def test_the_secret_is_private_from_its_first_byte_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, int] = {}
    real = os.open

    def spy(path: Path, flags: int, mode: int = 0o777) -> int:
        asked[Path(path).name] = mode if flags & os.O_EXCL and flags & os.O_CREAT else 0o777
        return real(path, flags, mode)

    monkeypatch.setattr(os, "open", spy)
    generate("car", tmp_path)
    assert asked["car.key_secret"] == 0o600


@pytest.mark.parametrize("there", ["car.key", "car.key_secret"])
def test_no_key_is_written_over(tmp_path: Path, there: str) -> None:
    (tmp_path / there).write_text("precious")
    with pytest.raises(FileExistsError, match=there):
        generate("car", tmp_path)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(there, "precious")]


def test_a_planted_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "car.key_secret").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileExistsError):
        generate("car", tmp_path)
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("name", ["", "..", ".car", "-car", "a/b", "../car", "a b", "ö", "x" * 65])
def test_names_that_are_none_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="name must be"):
        generate(name, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_no_key_is_made_where_others_may_write(tmp_path: Path) -> None:
    tmp_path.chmod(0o770)
    with pytest.raises(ValueError, match="not writable by group"):
        generate("car", tmp_path)


def test_no_text_of_a_pair_shows_the_secret(keys: Path) -> None:
    pair = load_own(keys / "car.key_secret")
    shown = StringIO()
    Console(file=shown, width=500).print(pair, {"pair": pair})
    for text in (repr(pair), str(pair), f"{pair}", repr([pair]), shown.getvalue()):
        assert pair.public.decode() in text
        assert pair.secret.decode() not in text


def _rewrite(old: bytes, new: bytes) -> Spoil:
    return lambda path: path.write_bytes(path.read_bytes().replace(old, new))


def _other_public(path: Path) -> None:
    own = zmq.auth.load_certificate(path)[0]
    _rewrite(own, zmq.curve_keypair()[0])(path)


def _as_link(path: Path) -> None:
    path.symlink_to(path.rename(path.with_name("real")))


def _as_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path, 0o600)


SPOILED_OWN: list[tuple[str, Spoil, str]] = [
    ("group reads", lambda path: path.chmod(0o640), "mode is 0640; chmod 600"),
    ("others read", lambda path: path.chmod(0o604), "mode is 0604; chmod 600"),
    ("link", _as_link, "symbolic link"),
    ("pipe", _as_pipe, "regular file"),
    ("replaceable", lambda path: path.parent.chmod(0o777), "folder of keys"),
    ("public only", lambda path: path.write_bytes(path.with_suffix(".key").read_bytes()), "no secret key"),
    ("empty", lambda path: path.write_bytes(b""), "no secret key"),
    ("truncated", lambda path: path.write_bytes(path.read_bytes()[:-20]), "40 characters of Z85"),
    ("no public", _rewrite(b"public-key", b"other-key"), "no public key"),
    ("not Z85", _rewrite(b'secret-key = "', b'secret-key = "~'), "40 characters of Z85"),
    ("doubled", lambda path: path.write_bytes(2 * path.read_bytes()), "more than one"),
    ("oversize", lambda path: path.write_bytes(path.read_bytes() + b"#" * 4096), "at most 4096 bytes"),
    ("mismatch", _other_public, "does not belong"),
]


@pytest.mark.parametrize(("spoil", "rule"), [case[1:] for case in SPOILED_OWN], ids=[case[0] for case in SPOILED_OWN])
def test_a_spoiled_secret_file_is_refused_by_name_and_says_nothing_of_the_secret(
    keys: Path, spoil: Spoil, rule: str
) -> None:
    path = keys / "car.key_secret"
    secret = load_own(path).secret.decode()
    spoil(path)
    with pytest.raises(ValueError, match=rule) as caught:
        load_own(path)
    assert str(keys) in str(caught.value)
    assert secret[:8] not in str(caught.value)


def test_values_outside_z85_are_refused() -> None:
    """40 characters of the alphabet, but `#####` is 85**5 - 1, more than 32 bits hold."""
    assert not curve_keys._is_key(b"#" * 40)
    assert curve_keys._is_key(b"0" * 40)


def test_a_key_in_a_directory_that_all_may_write_needs_the_sticky_bit(keys: Path) -> None:
    keys.chmod(0o1777)
    assert load_own(keys / "car.key_secret").public == load_public(keys / "car.key")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_a_secret_of_somebody_else_is_refused(keys: Path) -> None:
    os.chown(keys / "car.key_secret", 12345, -1)
    with pytest.raises(ValueError, match="user 12345's"):
        load_own(keys / "car.key_secret")


@pytest.mark.parametrize(
    ("spoil", "rule"),
    [
        (lambda path: path.chmod(0o664), "may change this key"),
        (_as_link, "symbolic link"),
        (lambda path: path.write_bytes(b'secret-key = "x'), "secret key where a public"),
        (lambda path: path.write_bytes(b"public-key = "), "40 characters"),
        (lambda path: path.write_bytes(b"# public-key"), "no public key"),
    ],
)
def test_a_spoiled_public_file_is_refused(keys: Path, spoil: Spoil, rule: str) -> None:
    spoil(keys / "car.key")
    with pytest.raises(ValueError, match=rule):
        load_public(keys / "car.key")


def test_allowed_keys_come_with_their_peers_names(allowed: Path) -> None:
    (allowed / "README").write_text("who is who")
    expected = {load_public(allowed / f"{name}.key"): name for name in ("desk", "lab")}
    assert load_allowed(allowed) == expected


@pytest.mark.parametrize(
    ("spoil", "rule"),
    [
        (lambda folder: folder.rename(folder.with_name("away")), "does not exist"),
        (lambda folder: [path.unlink() for path in folder.iterdir()], "nobody could connect"),
        (lambda folder: (folder / "x.key").write_bytes((folder / "lab.key").read_bytes()), "same key as lab"),
        (lambda folder: (folder / "x.key_secret").touch(), "secret key lies among"),
        (lambda folder: folder.chmod(0o770), "mode is 0770"),
        (lambda folder: folder.chmod(0o1777), "mode is 1777"),
        (lambda folder: (folder / ".key").touch(), "name must be"),
        (lambda folder: (folder / "lab.key").rename(folder / "l b.key"), "name must be"),
        (lambda folder: (folder / "lab.key").write_bytes(b""), "lab.key: holds no public key"),
    ],
)
def test_a_doubtful_list_of_peers_is_refused_whole(allowed: Path, spoil: Spoil, rule: str) -> None:
    spoil(allowed)
    with pytest.raises(ValueError, match=rule):
        load_allowed(allowed)


@pytest.mark.parametrize(
    ("address", "stays"),
    [
        ("tcp://127.0.0.1:5555", True),
        ("tcp://127.8.9.1:*", True),
        ("tcp://[::1]:5555", True),
        ("tcp://localhost:5555", True),
        ("tcp://*:5555", False),
        ("tcp://0.0.0.0:5555", False),
        ("tcp://[::]:5555", False),
        ("tcp://192.168.1.2:5555", False),
        ("tcp://localhost.example.org:5555", False),
        ("tcp://eth0:5555", False),
        # ZeroMQ's "source;destination", dressed up
        ("tcp://127.0.0.1:0;10.0.0.5:5555", False),
        ("tcp://127.0.0.1:1@10.0.0.5:5555", False),
        ("tcp://127.0.0.1", False),
        ("ipc:///tmp/x", False),
        ("", False),
    ],
)
def test_loopback_is_only_what_surely_is(address: str, stays: bool) -> None:
    assert is_loopback(address) is stays
