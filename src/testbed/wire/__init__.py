"""Messages, codec, keys, and the bus that carries them."""
