"""How alike two images are: PSNR, SSIM, LPIPS."""
