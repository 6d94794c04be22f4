/*
 * lasertrace: a simulator of laser-triangulation inspection, and its rays, from C.
 *
 * Made from the Rust source by cbindgen; do not edit.
 *
 * STATUS    Every function that can fail gives a lasertrace_status. After one other than
 *           LASERTRACE_STATUS_OK, lasertrace_last_error() says in English what was found
 *           and what was expected.
 * HANDLES   lasertrace_caster, lasertrace_scene, lasertrace_simulation and
 *           lasertrace_features are opaque. A handle that a ..._new, _load, _parse or
 *           _features function returns is freed once by ..._free. A handle that
 *           is freed, of another kind, or made up is found out and is an error.
 * BUFFERS   are the caller's. Each comes with the number of its elements, and a number that
 *           does not fit is an error; nothing is written past it. Buffers may not overlap.
 *           What the library cannot see is a number larger than the buffer really is.
 * THREADS   Any function may be called from any thread at any time, also with the same
 *           handle. A handle that one thread frees while another works with it is freed at
 *           the end of that work.
 * FLOATS    The caller's rounding mode, floating-point traps, exception flags and treatment of
 *           denormal numbers have no effect on results. Each call restores them at its end. A
 *           progress function is called with them.
 * STACK     A thread that calls the library needs 512 KiB of stack. Scenes of this repository
 *           needed between 96 and 128 KiB.
 * FORK      A child made by fork() after the first call cannot use the library, nor handles
 *           made before. Each function that can fail returns LASERTRACE_STATUS_RESOURCES there.
 *           Fork before the first call, or call exec in the child.
 * NUMBER    Handles are limited by memory and by the number of threads that the system grants:
 *           each caster and each simulation starts its threads when it is made, and ends them
 *           when it is freed. 2000 casters at once are tested.
 * UNITS     Millimetres, radians; counts of the sensor are 16-bit numbers.
 */

#ifndef LASERTRACE_H
#define LASERTRACE_H

#include <stddef.h>
#include <stdint.h>

/*
 Version of this header, to be compared with lasertrace_version(). While the major version is 0,
 the first two numbers must be equal.
 */
#define LASERTRACE_VERSION_MAJOR 0

/*
 See LASERTRACE_VERSION_MAJOR.
 */
#define LASERTRACE_VERSION_MINOR 3

/*
 See LASERTRACE_VERSION_MAJOR.
 */
#define LASERTRACE_VERSION_PATCH 0

/*
 Default ray-tracing backend: Embree, if the library is built with it.
 */
#define LASERTRACE_BACKEND_DEFAULT 0

/*
 Embree in 32-bit floats; every hit is recomputed in 64-bit floats.
 */
#define LASERTRACE_BACKEND_EMBREE 1

/*
 Rust implementation in 64-bit floats. It is slower and has no misses at vertices of open meshes.
 */
#define LASERTRACE_BACKEND_RUST 2

/*
 Value of `triangle` and `instance` if there is no hit.
 */
#define LASERTRACE_MISS UINT32_MAX

/*
 Value of `conformance`: the quantity has no tolerance.
 */
#define LASERTRACE_CONFORMANCE_NONE 0

/*
 Value of `conformance`: the deviation is inside the limits by at least the expanded uncertainty.
 */
#define LASERTRACE_CONFORMANCE_CONFORMS 1

/*
 Value of `conformance`: the deviation is outside the limits by more than the expanded
 uncertainty.
 */
#define LASERTRACE_CONFORMANCE_DOES_NOT_CONFORM 2

/*
 Value of `conformance`: the deviation is closer to a limit than the expanded uncertainty.
 */
#define LASERTRACE_CONFORMANCE_UNDECIDED 3

/*
 Value of `found`: the column contains no line.
 */
#define LASERTRACE_PROFILE_NOTHING 0

/*
 Value of `found`: a line was detected. Row, intensity, height, width and flags are set.
 */
#define LASERTRACE_PROFILE_LINE 1

/*
 Value of `found`: a point was computed. Position, uncertainties and deviation are set as well.
 */
#define LASERTRACE_PROFILE_POINT 2

/*
 A pixel of the line is saturated.
 */
#define LASERTRACE_FLAG_SATURATED 1

/*
 The column contains more than one line.
 */
#define LASERTRACE_FLAG_MULTIPLE_PEAKS 2

/*
 The line is wider than the other lines of the frame.
 */
#define LASERTRACE_FLAG_WIDE 4

/*
 The line is much lower than the other lines of the frame, or close to the noise.
 */
#define LASERTRACE_FLAG_LOW_SIGNAL 8

/*
 The line is cut off by the image border.
 */
#define LASERTRACE_FLAG_IMAGE_BORDER 16

/*
 The line is next to an occlusion or a discontinuity.
 */
#define LASERTRACE_FLAG_DISCONTINUITY 32

/*
 The stated uncertainty is outside its range of validity.
 */
#define LASERTRACE_FLAG_UNCERTAINTY_NOT_VALID 64

/*
 The line may be a reflection.
 */
#define LASERTRACE_FLAG_SUSPECTED_REFLECTION 128

/*
 Status of a call.
 */
typedef enum {
  /*
   Success.
   */
  LASERTRACE_STATUS_OK = 0,
  /*
   Invalid argument: NULL, a wrong length or an invalid ray.
   */
  LASERTRACE_STATUS_ARGUMENT = 1,
  /*
   Invalid handle: freed, of a different type, or never created.
   */
  LASERTRACE_STATUS_HANDLE = 2,
  /*
   Error in a scene or mesh file; the message contains file, line and key.
   */
  LASERTRACE_STATUS_INPUT = 3,
  /*
   File system error.
   */
  LASERTRACE_STATUS_FILE = 4,
  /*
   Insufficient memory or threads.
   */
  LASERTRACE_STATUS_RESOURCES = 5,
  /*
   Stopped by the progress function.
   */
  LASERTRACE_STATUS_STOPPED = 6,
  /*
   Error of Embree or a bug of this library; please report it.
   */
  LASERTRACE_STATUS_INTERNAL = 7,
} lasertrace_status;

/*
 Triangle mesh prepared for ray casting. Owns its data; the arrays it was created from may be
 freed.
 */
typedef struct lasertrace_caster lasertrace_caster;

/*
 Values of the features of a scene, in the order of `features.csv`. Owns its data; its simulation
 may be freed.
 */
typedef struct lasertrace_features lasertrace_features;

/*
 Validated scene: part, sensor and path.
 */
typedef struct lasertrace_scene lasertrace_scene;

/*
 Scene prepared for the simulation of frames. Owns its data; its scene may be freed.
 */
typedef struct lasertrace_simulation lasertrace_simulation;

/*
 Options of a caster. All fields zero selects the defaults.
 */
typedef struct {
  /*
   Ray-tracing backend: LASERTRACE_BACKEND_...
   */
  uint32_t backend;
  /*
   Number of threads, at most 1024; 0 selects one per core.
   */
  uint32_t threads;
  /*
   12 numbers for each instance of the mesh: the first three rows of the 4 x 4 matrix from the
   mesh frame to the common frame. It is a rotation and a translation (mm) without scaling or
   reflection. NULL: a single instance with the identity transform.
   */
  const double *instances;
  /*
   Number of instances; 0 if `instances` is NULL.
   */
  size_t instance_count;
} lasertrace_caster_options;

/*
 Ray from `origin` along `direction`.
 */
typedef struct {
  /*
   Origin, mm; coordinates within +-1e12.
   */
  double origin[3];
  /*
   Direction; its length may be 1e-100 to 1e100.
   */
  double direction[3];
  /*
   End of the ray in units of the length of `direction`: 0 to INFINITY.
   */
  double t_max;
} lasertrace_ray;

/*
 Point on the surface. Without a hit or nearest point: distance INFINITY, triangle and instance
 LASERTRACE_MISS, all other fields 0.
 */
typedef struct {
  /*
   For a ray, the parameter t >= 0 of the hit origin + t * direction; it is in mm if the
   direction has length 1. For a point, the distance to the surface, mm.
   */
  double distance;
  /*
   Coordinates, mm.
   */
  double point[3];
  /*
   Barycentric coordinates u and v, with u, v >= 0 and u + v <= 1. For corners a, b and c, the
   point is (1 - u - v) * a + u * b + v * c.
   */
  double barycentric[2];
  /*
   Index of the triangle.
   */
  uint32_t triangle;
  /*
   Index of the instance; 0 for a mesh without instances.
   */
  uint32_t instance;
} lasertrace_surface_point;

/*
 Value of a quantity of a feature, or the reason why a feature has no value. Numbers are in the
 unit at the end of the quantity's name (mm or degrees), and 0 where they do not apply. The
 strings are UTF-8 and valid until the lasertrace_features is freed.
 */
typedef struct {
  /*
   Name of the feature.
   */
  const char *feature;
  /*
   Kind of the feature, as in the scene file.
   */
  const char *kind;
  /*
   Name of the quantity, for example "diameter_mm"; NULL for a feature without values.
   */
  const char *quantity;
  /*
   Reason why the feature has no values; NULL for a value.
   */
  const char *problem;
  /*
   Value of the CAD.
   */
  double nominal;
  /*
   Measured value.
   */
  double measured;
  /*
   Measured minus nominal value.
   */
  double deviation;
  /*
   Standard uncertainty of the measured value.
   */
  double standard_uncertainty;
  /*
   Expanded uncertainty U: k = 2, and 2 to 2.9 for a displacement or tilt.
   */
  double expanded_uncertainty;
  /*
   Lower limit of the deviation; 0 without a tolerance.
   */
  double lower;
  /*
   Upper limit of the deviation; 0 without a tolerance.
   */
  double upper;
  /*
   Ratio of U and the width of the tolerance; 0 without a tolerance.
   */
  double u_over_t;
  /*
   Width of the smallest tolerance whose conformance can be proven.
   */
  double smallest_tolerance;
  /*
   Number of points that the value uses.
   */
  uint64_t points;
  /*
   Conformance with the tolerance by ISO 14253-1: LASERTRACE_CONFORMANCE_...
   */
  uint32_t conformance;
  /*
   1 if the uncertainties are lower bounds, because the scene has no systematic errors of sensor
   and stage; otherwise 0.
   */
  uint32_t lower_bound;
} lasertrace_feature_value;

/*
 Dimensions that determine the size of the frame buffers.
 */
typedef struct {
  /*
   Number of pixels along the laser line.
   */
  uint32_t columns;
  /*
   Number of pixels perpendicular to the laser line.
   */
  uint32_t rows;
  /*
   Number of frames of the scan.
   */
  uint32_t frames;
} lasertrace_size;

/*
 Measurement in one column of a frame. Unset fields are 0.
 */
typedef struct {
  /*
   Position in the part frame, mm.
   */
  double position[3];
  /*
   Standard uncertainty of the position, mm.
   */
  double u_position;
  /*
   Signed distance to the CAD surface, mm; positive outside the material.
   */
  double deviation;
  /*
   Standard uncertainty of the deviation, mm.
   */
  double u_deviation;
  /*
   Standard deviation of the position without speckle and calibration, mm.
   */
  double repeatability;
  /*
   Correlation length of the errors along the profile, mm.
   */
  double correlation_length;
  /*
   Correlation length of the errors along the scan, mm.
   */
  double scan_correlation_length;
  /*
   Row of the line; pixel j covers j to j + 1.
   */
  double row;
  /*
   Sum of the line's counts above the background.
   */
  double intensity;
  /*
   Counts above the background of the highest pixel.
   */
  double height;
  /*
   Standard deviation of the line profile along the column, px.
   */
  double line_sigma_px;
  /*
   Index of the frame.
   */
  uint32_t frame;
  /*
   Index of the column.
   */
  uint32_t column;
  /*
   Sum of LASERTRACE_FLAG_... values.
   */
  uint32_t flags;
  /*
   Contents: LASERTRACE_PROFILE_...
   */
  uint32_t found;
} lasertrace_profile_point;

/*
 Output buffers for frames. A buffer that is NULL with length 0 is not filled. Each other buffer
 holds all frames of the call, one after the other.
 */
typedef struct {
  /*
   Sensor counts in row-major order: frames * rows * columns elements.
   */
  uint16_t *images;
  /*
   Number of elements of `images`.
   */
  size_t image_length;
  /*
   Depth at the pixel centres along the camera axis, mm, in row-major order; INFINITY where no
   surface is visible: frames * rows * columns elements.
   */
  float *depths;
  /*
   Number of elements of `depths`.
   */
  size_t depth_length;
  /*
   Measurements, one element per column: frames * columns elements.
   */
  lasertrace_profile_point *profiles;
  /*
   Number of elements of `profiles`.
   */
  size_t profile_length;
} lasertrace_frames;

/*
 Progress callback, called after each frame on the thread that called
 lasertrace_simulation_frames(). `done` and `total` are the completed and requested numbers of
 frames, `user` is the pointer given by the caller. A non-zero return value stops the simulation.
 The function must return normally, without longjmp or C++ exceptions.
 */
typedef int (*lasertrace_progress)(uint32_t done, uint32_t total, void *user);

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/*
 Returns the version of the loaded library, for example "0.3.0". The string is valid for the
 lifetime of the program.
 */
const char *lasertrace_version(void);

/*
 Creates a caster from triangles. `vertices` are `vertex_count` times three 64-bit floats (mm).
 `triangles` are `triangle_count` times three vertex indices. All data is copied. `options` may
 be NULL. Triangles without area are kept: no ray hits them, but they can be nearest to a point.

 Returns LASERTRACE_STATUS_ARGUMENT in four cases: a vertex is not finite or beyond 1e12 mm, an
 index is out of range, a matrix is not a rotation, or there are no triangles. The message
 contains the index of the invalid element. Returns LASERTRACE_STATUS_RESOURCES if memory is
 insufficient. In both cases `*out` is NULL.
 */
lasertrace_status lasertrace_caster_new(const double *vertices,
                                        size_t vertex_count,
                                        const uint32_t *triangles,
                                        size_t triangle_count,
                                        const lasertrace_caster_options *options,
                                        lasertrace_caster **out);

/*
 Creates a caster as lasertrace_caster_new() from vertices that are 32-bit floats.
 */
lasertrace_status lasertrace_caster_new_f32(const float *vertices,
                                            size_t vertex_count,
                                            const uint32_t *triangles,
                                            size_t triangle_count,
                                            const lasertrace_caster_options *options,
                                            lasertrace_caster **out);

/*
 Frees a caster. NULL is ignored and returns LASERTRACE_STATUS_OK.
 */
lasertrace_status lasertrace_caster_free(lasertrace_caster *caster);

/*
 Casts `ray_count` rays and writes the first hit of each to `hits`. `hit_count` must equal
 `ray_count`.

 Both sides of a triangle are hit. If two triangles are at the same distance, the result depends
 on the 16 rays traced together, never on the number of threads. LIMITS.md describes hits that
 may be missed: at the boundaries of open meshes, and on surfaces closer to the origin of a ray
 than 2^-20 of the part size.

 Returns LASERTRACE_STATUS_ARGUMENT for an invalid ray (NaN, a direction of length 0). The
 message contains the index of the ray, and all hits are LASERTRACE_MISS.
 */
lasertrace_status lasertrace_closest_hits(const lasertrace_caster *caster,
                                          const lasertrace_ray *rays,
                                          size_t ray_count,
                                          lasertrace_surface_point *hits,
                                          size_t hit_count);

/*
 Casts `ray_count` rays and writes 1 to `hit` for each ray that hits the mesh, otherwise 0. The
 result is consistent with lasertrace_closest_hits().
 */
lasertrace_status lasertrace_any_hits(const lasertrace_caster *caster,
                                      const lasertrace_ray *rays,
                                      size_t ray_count,
                                      uint8_t *hit,
                                      size_t hit_count);

/*
 Writes to `nearest` the surface point nearest to each of `point_count` points. A point consists
 of three 64-bit floats (mm, within +-1e12). Errors are the errors of lasertrace_closest_hits().
 */
lasertrace_status lasertrace_nearest_points(const lasertrace_caster *caster,
                                            const double *points,
                                            size_t point_count,
                                            lasertrace_surface_point *nearest,
                                            size_t nearest_count);

/*
 Counts all hits of `ray_count` rays, as lasertrace_all_hits() finds them. `count_count` must
 equal `ray_count`. Errors are the errors of lasertrace_closest_hits(); all counts are then 0.
 */
lasertrace_status lasertrace_count_hits(const lasertrace_caster *caster,
                                        const lasertrace_ray *rays,
                                        size_t ray_count,
                                        uint64_t *counts,
                                        size_t count_count);

/*
 Finds all hits of `ray_count` rays, at most `limit` per ray, ordered by ray and then by
 distance. Hit k of ray i is `hits[starts[i] + k]`; `starts[ray_count]` is the number of all
 hits, therefore `start_count` must be `ray_count` + 1. `entering` is 1 for a hit on the front of
 a triangle, on which its corners are counter-clockwise, otherwise 0.

 Each surface is hit once, also at a common edge or vertex of triangles. A ray that touches the
 outline of a closed mesh enters and leaves at one distance, or has no hit. Both backends give
 equal results. The first call with Embree builds a second hierarchy.

 `hits` and `entering` have room for `hit_count` hits each. If there are more hits, returns
 LASERTRACE_STATUS_ARGUMENT and writes only `starts`, so that a call with `hit_count` 0 returns
 the room that is required. Returns the errors of lasertrace_closest_hits(), and
 LASERTRACE_STATUS_RESOURCES if memory for the hits is insufficient; `starts` are then 0.
 */
lasertrace_status lasertrace_all_hits(const lasertrace_caster *caster,
                                      const lasertrace_ray *rays,
                                      size_t ray_count,
                                      size_t limit,
                                      size_t *starts,
                                      size_t start_count,
                                      lasertrace_surface_point *hits,
                                      uint8_t *entering,
                                      size_t hit_count);

/*
 Writes 1 to `inside` for each of `point_count` points inside the closed mesh, otherwise 0. The
 parity of the hits along a ray decides, therefore winding has no effect.

 Returns LASERTRACE_STATUS_ARGUMENT for an open mesh and for an invalid point; all of `inside` is
 then 0.
 */
lasertrace_status lasertrace_contains_points(const lasertrace_caster *caster,
                                             const double *points,
                                             size_t point_count,
                                             uint8_t *inside,
                                             size_t inside_count);

/*
 Writes the generalised winding number around each of `point_count` points: the sum of the solid
 angles of all triangles, divided by 4 pi. It is 1 inside and 0 outside a closed mesh that is
 wound outward, and a fraction for an open mesh. The time per point is proportional to the number
 of triangles.
 */
lasertrace_status lasertrace_winding_numbers(const lasertrace_caster *caster,
                                             const double *points,
                                             size_t point_count,
                                             double *numbers,
                                             size_t number_count);

/*
 Writes the distance from each of `point_count` points to the closed mesh, mm: negative inside,
 as lasertrace_contains_points() decides. Errors are the errors of that function; all distances
 are then INFINITY.
 */
lasertrace_status lasertrace_signed_distances(const lasertrace_caster *caster,
                                              const double *points,
                                              size_t point_count,
                                              double *distances,
                                              size_t distance_count);

/*
 Writes the thickness of the part along each of `ray_count` rays: the length of the first section
 inside the closed mesh, in units of the length of `direction`; 0 without such a section.

 Returns LASERTRACE_STATUS_ARGUMENT for an open mesh and for an invalid ray; all thicknesses are
 then 0.
 */
lasertrace_status lasertrace_thicknesses(const lasertrace_caster *caster,
                                         const lasertrace_ray *rays,
                                         size_t ray_count,
                                         double *thicknesses,
                                         size_t thickness_count);

/*
 Simulates all frames of the scan, with the profile filters and the alignment of the scene, and
 evaluates its features. The numbers are those of `features.csv` of `lasertrace scan`. A scene
 without features has 0 values.
 */
lasertrace_status lasertrace_simulation_features(const lasertrace_simulation *simulation,
                                                 lasertrace_features **out);

/*
 Writes the number of values to `out`.
 */
lasertrace_status lasertrace_features_count(const lasertrace_features *features, uint64_t *out);

/*
 Writes the value of an index, 0 to count - 1, to `out`.
 */
lasertrace_status lasertrace_features_value(const lasertrace_features *features,
                                            uint64_t index,
                                            lasertrace_feature_value *out);

/*
 Frees the values. NULL is ignored and returns LASERTRACE_STATUS_OK.
 */
lasertrace_status lasertrace_features_free(lasertrace_features *features);

/*
 Reads a scene file (TOML, see docs/keys.md) and its mesh. Returns LASERTRACE_STATUS_INPUT for
 an error in one of them; the message contains file, line and key.
 */
lasertrace_status lasertrace_scene_load(const char *path, lasertrace_scene **out);

/*
 Reads a scene from text (TOML). Relative file names are resolved in `folder`. Errors are the
 errors of lasertrace_scene_load().
 */
lasertrace_status lasertrace_scene_parse(const char *toml,
                                         const char *folder,
                                         lasertrace_scene **out);

/*
 Frees a scene. NULL is ignored and returns LASERTRACE_STATUS_OK.
 */
lasertrace_status lasertrace_scene_free(lasertrace_scene *scene);

/*
 Writes the frame size and the number of frames of a scene to `out`.
 */
lasertrace_status lasertrace_scene_size(const lasertrace_scene *scene, lasertrace_size *out);

/*
 Creates a simulation: plans the scene and builds the data common to all frames. `threads` is at
 most 1024; 0 selects one per core. Returns LASERTRACE_STATUS_RESOURCES if memory is
 insufficient.
 */
lasertrace_status lasertrace_simulation_new(const lasertrace_scene *scene,
                                            uint32_t threads,
                                            lasertrace_simulation **out);

/*
 Frees a simulation. NULL is ignored and returns LASERTRACE_STATUS_OK.
 */
lasertrace_status lasertrace_simulation_free(lasertrace_simulation *simulation);

/*
 Simulates `frame_count` frames in parallel, starting with index `first_frame`, and fills the
 buffers of `frames`. A frame depends only on its index and is byte-identical to the output of
 `lasertrace render`.

 Flags equal the flags of `lasertrace scan` with the same frames. DISCONTINUITY depends on
 neighbouring frames. For profiles, neighbours outside the call are simulated too, so a call with
 many frames is faster than many calls. SUSPECTED_REFLECTION by lines of sight requires all
 frames of the scan in one call. Profile filters of the scene are not applied.

 `progress` may be NULL. If it stops the simulation, the status is LASERTRACE_STATUS_STOPPED.
 Frames that were not simulated contain counts 0, depths INFINITY and profiles with
 LASERTRACE_PROFILE_NOTHING. The flags of the other frames do not consider neighbouring frames.
 */
lasertrace_status lasertrace_simulation_frames(const lasertrace_simulation *simulation,
                                               uint32_t first_frame,
                                               uint32_t frame_count,
                                               const lasertrace_frames *frames,
                                               lasertrace_progress progress,
                                               void *user);

/*
 Returns the message of the last failed call of this thread in UTF-8, preceded by the name of the
 function. Returns "" if no call has failed. The string is valid until the next failed call of
 this thread.
 */
const char *lasertrace_last_error(void);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* LASERTRACE_H */
