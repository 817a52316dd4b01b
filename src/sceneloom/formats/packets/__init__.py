"""Lidar packets as their sensors send them, and captures of networks (`.pcap`, `.pcapng`) that hold them."""
