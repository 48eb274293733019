"""L1 and SSIM of images, and the adjoint."""
