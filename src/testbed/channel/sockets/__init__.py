"""Links over real sockets, without privileges: what the pipelines decide, done to real packets in wall time."""
