from itertools import product

from vg2gt.method import DenseHead


def test_full_resolution_for_every_number_of_taps(make_room):
    tokens, _, images = make_room(scenes=2)
    for taps, finest in product((1, 2, 3, 4), (1, 4)):
        head = DenseHead([24] * taps, 14, features=8, out_channels=5, merge_channels=6, finest=finest)
        assert head(tokens.with_patch((tokens.patch * 2)[:taps]), images).shape == (6, 5, 42, 84)


def test_every_tap_and_the_image_reach_every_view(make_room):
    tokens, _, images = make_room()
    head = DenseHead([24, 24], 14, features=8, out_channels=5)
    inputs = [tap.requires_grad_() for tap in tokens.patch] + [images.requires_grad_()]
    head(tokens, images).square().sum().backward()
    for x in inputs:
        assert (x.grad.flatten(2).abs().sum(-1) > 0).all()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in head.parameters())
