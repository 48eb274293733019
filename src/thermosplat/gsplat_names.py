"""Public names of gsplat, of 1.5.3 and its main branch, that thermosplat does not have, and what there is instead."""

_IN_PLACE: dict[str, str] = {
    "DefaultStrategy MCMCStrategy Strategy": (
        "gsplat's own densifies on rasterization()'s info, as docs/migrating.md says; thermosplat-train has its own"
    ),
    "PngCompression export_splats": "thermosplat-export writes trained scenes, and gsplat's own takes any tensors",
    "accumulate rasterize_contributing_gaussian_ids rasterize_contributing_gaussian_ids_sparse "
    "rasterize_num_contributing_gaussians rasterize_num_contributing_gaussians_sparse rasterize_to_indices_in_range "
    "rasterize_top_contributing_gaussian_ids rasterize_top_contributing_gaussian_ids_sparse": (
        "rasterization()'s info lists each tile's Gaussians, as flatten_ids and isect_offsets, and the gradient of "
        "image.sum() to colors sums each Gaussian's weights"
    ),
    "build_sparse_tile_layout isect_tiles_sparse rasterize_to_pixels_sparse": (
        "rasterize_to_pixels() blends whole images, and its masks choose tiles"
    ),
    "proj world_to_cam": "both are parts of fully_fused_projection()",
    "fully_fused_projection_with_ut": "rasterization(with_ut=True) projects by the unscented transform",
    "rasterize_to_pixels_eval3d": "rasterization(with_eval3d=True) blends along rays",
    "spherical_harmonics_l0 spherical_harmonics_l1_plus": "rasterization() takes the pair (sh0, shN) as colors",
    "accumulate_2dgs fully_fused_projection_2dgs rasterization_2dgs rasterization_2dgs_inria_wrapper "
    "rasterize_to_indices_in_range_2dgs rasterize_to_pixels_2dgs": "there are no 2D Gaussians",
    "rasterization_inria_wrapper": "rasterization() takes cameras as viewmats and Ks",
    "ExternalDistortionModelMeta ExternalDistortionModelParameters": (
        "a lens distorts by radial_coeffs, tangential_coeffs, thin_prism_coeffs or ftheta_coeffs"
    ),
    "LidarTiling RowOffsetStructuredSpinningLidarModelParameters RowOffsetStructuredSpinningLidarModelParametersExt "
    "SpinningDirection compute_lidar_angles_to_columns_map compute_lidar_tiling isect_tiles_lidar "
    "lidar_background_loss lidar_distance_loss lidar_intensity_loss lidar_raydrop_loss": "there are no lidars",
    "RendererConfig RendererConfig_MixedBatch RendererConfig_ParallelBatch": (
        "rays are blended in one way: leave renderer_config out"
    ),
    "l1_loss mse_loss": "torch.nn.functional has it",
    "create_ssim_window ssim_loss torch_ssim_loss": "thermosplat.image_quality.ssim measures SSIM",
    "FusedGaussianLosses depth_l1_loss gaussian_density_reg gaussian_scale_reg gaussian_z_scale_reg opacity_reg_loss "
    "out_of_bound_loss scale_reg_loss total_variation_loss": "losses are the trainer's: thermosplat.losses has its own",
    "color_correct_affine color_correct_quadratic": "colours are compared as they are rendered",
    "has_2dgs has_3dgs has_3dgut has_adam has_camera_wrappers has_losses has_reloc": (
        "kernels are compiled when they are first used; 2D Gaussians and lidars there are none"
    ),
}

INSTEAD: dict[str, str] = {name: instead for names, instead in _IN_PLACE.items() for name in names.split()}
"""By name, what there is."""
