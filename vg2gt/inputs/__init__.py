"""Turns what people have (photographs, videos, recordings, camera files) into pictures with cameras."""
