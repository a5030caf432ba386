"""What runs in real time: the only room that owns clocks, threads and sockets."""
