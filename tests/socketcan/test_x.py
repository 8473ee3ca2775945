import subprocess, time
def test_x():
    import numpy, can, canopen
    print(subprocess.run("ip -d link; ls /sys/class/net; mount | head -30", shell=True, capture_output=True, text=True).stdout)
