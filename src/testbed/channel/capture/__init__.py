"""Traces from elsewhere: captures of packets (pcap, pcapng) and logs of ping. Files in, rows of a trace out."""
