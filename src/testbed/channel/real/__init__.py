"""Links of a run whose packets go through real sockets, between two zenoh sessions, in real time.

role ─ stdin ─► end a: a session ═══ relay, or two network namespaces ═══ a session: end b ─ stdout ─► role
"""
