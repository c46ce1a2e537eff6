"""The other end of tests/examples/noise_end.rs, by two implementations of Noise that share no code with it.

Every suite, either end as the initiator, frames under nonces that are not in order. Python's keys are fixed,
and so are those of the product: both implementations must send the same bytes.
"""
import subprocess
import sys

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from dissononce.cipher.aesgcm import AESGCMCipher
from dissononce.cipher.chachapoly import ChaChaPolyCipher
from dissononce.dh.x25519.x25519 import PrivateKey, PublicKey, X25519DH
from dissononce.hash.sha256 import SHA256Hash
from dissononce.processing.handshakepatterns.interactive.KK import KKHandshakePattern
from dissononce.processing.impl.cipherstate import CipherState
from dissononce.processing.impl.handshakestate import HandshakeState
from dissononce.processing.impl.symmetricstate import SymmetricState
from noise.connection import Keypair, NoiseConnection

PROLOGUE = b"blastema link 2"


def key(number):
    return bytes([1]) + bytes([number]) * 31


def public(secret):
    return X25519PrivateKey.from_private_bytes(secret).public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)


class NoiseProtocol:
    """Package noiseprotocol."""

    def __init__(self, suite, initiates, own, other, ephemeral):
        self.connection = NoiseConnection.from_name(f"Noise_KK_25519_{suite}_SHA256".encode())
        self.connection.set_prologue(PROLOGUE)
        self.connection.set_keypair_from_private_bytes(Keypair.STATIC, own)
        self.connection.set_keypair_from_private_bytes(Keypair.EPHEMERAL, ephemeral)
        self.connection.set_keypair_from_public_bytes(Keypair.REMOTE_STATIC, public(other))
        (self.connection.set_as_initiator if initiates else self.connection.set_as_responder)()
        self.connection.start_handshake()

    def write(self, payload):
        return bytes(self.connection.write_message(payload))

    def read(self, message):
        return bytes(self.connection.read_message(message))

    def seal(self, nonce, text):
        cipher = self.connection.noise_protocol.cipher_state_encrypt
        cipher.n = nonce
        return bytes(cipher.encrypt_with_ad(b"", text))

    def open(self, nonce, frame):
        cipher = self.connection.noise_protocol.cipher_state_decrypt
        cipher.n = nonce
        return bytes(cipher.decrypt_with_ad(b"", frame))


class Dissononce:
    """Package dissononce."""

    def __init__(self, suite, initiates, own, other, ephemeral):
        class Fixed(X25519DH):
            def generate_keypair(self, privatekey=None):
                return super().generate_keypair(privatekey or PrivateKey(ephemeral))

        cipher = AESGCMCipher() if suite == "AESGCM" else ChaChaPolyCipher()
        symmetric = SymmetricState(CipherState(cipher), SHA256Hash())
        self.state, self.initiates = HandshakeState(symmetric, Fixed()), initiates
        pair = X25519DH().generate_keypair(PrivateKey(own))
        self.state.initialize(KKHandshakePattern(), initiates, PROLOGUE, pair, rs=PublicKey(public(other)))

    def step(self, step, given):
        out = bytearray()
        ciphers = step(given, out)
        if ciphers:
            self.sealing, self.opening = ciphers if self.initiates else reversed(ciphers)
        return bytes(out)

    def write(self, payload):
        return self.step(self.state.write_message, payload)

    def read(self, message):
        return self.step(self.state.read_message, message)

    def seal(self, nonce, text):
        self.sealing.set_nonce(nonce)
        return bytes(self.sealing.encrypt_with_ad(b"", text))

    def open(self, nonce, frame):
        self.opening.set_nonce(nonce)
        return bytes(self.opening.decrypt_with_ad(b"", frame))


def talk(program, suite, other_end, initiates):
    """Returns all that was sent, in order."""
    role = "responder" if initiates else "initiator"
    pipe = subprocess.PIPE
    with subprocess.Popen([program, suite, role], stdin=pipe, stdout=pipe, text=True) as product:
        sent = []

        def read():
            sent.append(bytes.fromhex(product.stdout.readline().strip()))
            return sent[-1]

        def write(message):
            sent.append(message)
            product.stdin.write(message.hex() + "\n")
            product.stdin.flush()

        numbers = (0x11, 0x22, 0x33) if initiates else (0x22, 0x11, 0x44)
        end = other_end(suite, initiates, *map(key, numbers))
        if initiates:
            write(end.write(b"hello from i"))
            assert end.read(read()) == b"hello from r"
        else:
            assert end.read(read()) == b"hello from i"
            write(end.write(b"hello from r"))
        for nonce in (0, 1, 7, 4_000_000_000):
            assert end.open(nonce, read()) == b"rust %d" % nonce
            write(end.seal(nonce, b"python %d" % nonce))
        assert read() == b"ok" and product.wait() == 0
    return sent


for suite in ("AESGCM", "ChaChaPoly"):
    for initiates in (True, False):
        both = [talk(sys.argv[1], suite, end, initiates) for end in (NoiseProtocol, Dissononce)]
        assert both[0] == both[1], "two implementations send different bytes"
        print(f"Noise_KK_25519_{suite}_SHA256, {'python' if initiates else 'the product'} begins: both agree")
