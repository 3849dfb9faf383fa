"""Where camera frames come from: a folder of pictures, a stereo camera, a socket."""
