"""Links through the kernel: two hosts, network namespaces, and between them a pipeline on real IP packets.

    host a ── TUN ── switch: a pipeline each way ── TUN ── host b

Drops happen between the TUN devices, that is at the receiver's ingress: the sender's TCP never learns of one. Neither
namespace has a name, and no device is persistent: when the processes are gone, so is everything else.
"""
