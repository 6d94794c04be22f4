/*
 * lasertrace: a simulator of laser-triangulation inspection, and its rays, from C.
 *
 * Made from the Rust source by cbindgen; do not edit.
 *
 * STATUS    Every function that can fail gives a lasertrace_status. After one other than
 *           LASERTRACE_STATUS_OK, lasertrace_last_error() says in English what was found
 *           and what was expected.
 * HANDLES   lasertrace_caster, lasertrace_scene and lasertrace_simulation are opaque.
 *           What a ..._new, _load or _parse gives is freed once by ..._free. A handle that
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
 Version of this header. A program may compare it with lasertrace_version(): as long as the
 first number is 0, the first two must be the same.
 */
#define LASERTRACE_VERSION_MAJOR 0

/*
 See LASERTRACE_VERSION_MAJOR.
 */
#define LASERTRACE_VERSION_MINOR 2

/*
 See LASERTRACE_VERSION_MAJOR.
 */
#define LASERTRACE_VERSION_PATCH 0

/*
 What finds the triangles: Embree, where this library is built with it.
 */
#define LASERTRACE_BACKEND_DEFAULT 0

/*
 Embree in 32-bit floats, each hit settled in 64.
 */
#define LASERTRACE_BACKEND_EMBREE 1

/*
 A tree in Rust in 64-bit floats: slower, and without a miss at vertices of open meshes.
 */
#define LASERTRACE_BACKEND_RUST 2

/*
 What `triangle` and `instance` are where there is nothing.
 */
#define LASERTRACE_NOTHING UINT32_MAX

/*
 What a column of a profile holds: nothing; a line that the sensor saw; and its point.
 */
#define LASERTRACE_PROFILE_NOTHING 0

/*
 Row, intensity, height, width and flags are set.
 */
#define LASERTRACE_PROFILE_LINE 1

/*
 And position, uncertainties and deviation.
 */
#define LASERTRACE_PROFILE_POINT 2

/*
 A pixel of the line is saturated.
 */
#define LASERTRACE_FLAG_SATURATED 1

/*
 The column holds another line.
 */
#define LASERTRACE_FLAG_DOUBLE 2

/*
 Wider than the frame's other lines.
 */
#define LASERTRACE_FLAG_WIDE 4

/*
 Much lower than the frame's other lines, or little above the noise.
 */
#define LASERTRACE_FLAG_WEAK 8

/*
 Cut off by the border of the sensor.
 */
#define LASERTRACE_FLAG_BORDER 16

/*
 At an occlusion or a jump.
 */
#define LASERTRACE_FLAG_EDGE 32

/*
 Its uncertainty is not known to hold.
 */
#define LASERTRACE_FLAG_OUTSIDE 64

/*
 Possibly a reflection.
 */
#define LASERTRACE_FLAG_GHOST 128

/*
 How a call went.
 */
typedef enum {
  /*
   Done.
   */
  LASERTRACE_STATUS_OK = 0,
  /*
   An argument is wrong: NULL, a number that does not fit, a ray that is none.
   */
  LASERTRACE_STATUS_ARGUMENT = 1,
  /*
   A handle is not live: freed, of another kind, or made up.
   */
  LASERTRACE_STATUS_HANDLE = 2,
  /*
   A scene or mesh file is wrong; the message names file, line and key.
   */
  LASERTRACE_STATUS_INPUT = 3,
  /*
   The file system refused.
   */
  LASERTRACE_STATUS_FILE = 4,
  /*
   Too little memory, or no thread to be had.
   */
  LASERTRACE_STATUS_RESOURCES = 5,
  /*
   The progress function asked to stop.
   */
  LASERTRACE_STATUS_STOPPED = 6,
  /*
   A failure of Embree, or a defect of this library: please report it.
   */
  LASERTRACE_STATUS_INTERNAL = 7,
} lasertrace_status;

/*
 Triangles made ready for rays. Owns all it needs: what it was made of may be freed.
 */
typedef struct lasertrace_caster lasertrace_caster;

/*
 A scene that was read and found right: part, sensor and path.
 */
typedef struct lasertrace_scene lasertrace_scene;

/*
 A scene made ready to take frames. Owns all it needs: its scene may be freed.
 */
typedef struct lasertrace_simulation lasertrace_simulation;

/*
 How a caster is made. All zero is the default.
 */
typedef struct {
  /*
   LASERTRACE_BACKEND_...
   */
  uint32_t backend;
  /*
   Threads that cast: 0 for one a core, at most 1024.
   */
  uint32_t threads;
  /*
   12 numbers for each instance of the mesh: the first three rows of the 4 x 4 matrix
   that takes its points to the common frame, a rotation and a translation (mm) without
   scale or mirror. NULL: the mesh itself, once and unmoved.
   */
  const double *instances;
  /*
   Number of instances; 0 if `instances` is NULL.
   */
  size_t instance_count;
} lasertrace_caster_options;

/*
 The half-line from `origin` along `direction`.
 */
typedef struct {
  /*
   mm, within 1e12.
   */
  double origin[3];
  /*
   Of any length from 1e-100 to 1e100.
   */
  double direction[3];
  /*
   Where it ends, in lengths of `direction`: from 0 to INFINITY.
   */
  double t_max;
} lasertrace_ray;

/*
 A place on the surface. Where there is none: distance INFINITY, triangle and instance
 LASERTRACE_NOTHING, all else 0.
 */
typedef struct {
  /*
   Of a ray, t from 0, where the place is origin + t * direction: mm if the direction is
   of length 1. Of a point, its distance, mm.
   */
  double distance;
  /*
   mm.
   */
  double point[3];
  /*
   u and v from 0, u + v at most 1: the place (1 - u - v) * a + u * b + v * c of a triangle
   with corners a, b and c.
   */
  double barycentric[2];
  /*
   Number of the triangle.
   */
  uint32_t triangle;
  /*
   Number of the instance; 0 for a mesh without instances.
   */
  uint32_t instance;
} lasertrace_surface_point;

/*
 What the buffers for frames are sized by.
 */
typedef struct {
  /*
   Pixels along the laser's line.
   */
  uint32_t columns;
  /*
   Pixels across it.
   */
  uint32_t rows;
  /*
   Frames of the scan.
   */
  uint32_t frames;
} lasertrace_size;

/*
 What was measured in one column of a frame. What is not set is 0.
 */
typedef struct {
  /*
   mm, in the part's frame.
   */
  double position[3];
  /*
   Standard uncertainty of the position, mm.
   */
  double sigma;
  /*
   Signed distance to the CAD, mm; positive outside the material.
   */
  double deviation;
  /*
   Standard uncertainty of the deviation, mm.
   */
  double deviation_sigma;
  /*
   Row of the line; pixel j covers j to j + 1.
   */
  double row;
  /*
   Sum of the line's counts above background.
   */
  double intensity;
  /*
   Counts above background of its highest pixel.
   */
  double height;
  /*
   Standard deviation of the line across its length, px.
   */
  double width;
  /*
   Number of the frame.
   */
  uint32_t frame;
  /*
   Number of the column.
   */
  uint32_t column;
  /*
   LASERTRACE_FLAG_... added up.
   */
  uint32_t flags;
  /*
   LASERTRACE_PROFILE_...
   */
  uint32_t found;
} lasertrace_profile_point;

/*
 Where frames are written to. A buffer that is NULL, with length 0, is not wanted; one that
 is wanted holds all frames of the call, one after the other.
 */
typedef struct {
  /*
   Counts of the sensor, row by row: frames * rows * columns.
   */
  uint16_t *images;
  /*
   Number of elements.
   */
  size_t image_length;
  /*
   Distance along the camera's axis of what each pixel's centre sees, mm, row by row;
   INFINITY where that is nothing: frames * rows * columns.
   */
  float *depths;
  /*
   Number of elements.
   */
  size_t depth_length;
  /*
   What was measured, one element a column: frames * columns.
   */
  lasertrace_profile_point *profiles;
  /*
   Number of elements.
   */
  size_t profile_length;
} lasertrace_frames;

/*
 Called after a frame on the thread that called lasertrace_simulation_frames(), with the
 number of frames done and asked for and the pointer that was given; anything but 0
 stops. It must return: no longjmp and no C++ exception out of it.
 */
typedef int (*lasertrace_progress)(uint32_t done, uint32_t total, void *user);

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/*
 Version of the library that is loaded, as "0.2.0". Lives as long as the program.
 */
const char *lasertrace_version(void);

/*
 Makes a caster of triangles whose vertices are 64-bit floats (mm), `vertex_count` times
 three; a triangle is three numbers of vertices, `triangle_count` times three. Everything
 is copied. `options` may be NULL. Triangles without area are kept: no ray meets them, but
 they can be nearest to a point.

 LASERTRACE_STATUS_ARGUMENT for a vertex that is not finite or beyond 1e12 mm, an index
 without a vertex, a matrix that is no rotation (the message has the number of each), or
 no triangle; LASERTRACE_STATUS_RESOURCES for too little memory. `*out` is then NULL.
 */
lasertrace_status lasertrace_caster_new(const double *vertices,
                                        size_t vertex_count,
                                        const uint32_t *triangles,
                                        size_t triangle_count,
                                        const lasertrace_caster_options *options,
                                        lasertrace_caster **out);

/*
 lasertrace_caster_new() for vertices that are 32-bit floats.
 */
lasertrace_status lasertrace_caster_new_f32(const float *vertices,
                                            size_t vertex_count,
                                            const uint32_t *triangles,
                                            size_t triangle_count,
                                            const lasertrace_caster_options *options,
                                            lasertrace_caster **out);

/*
 Frees a caster. NULL is nothing to free, and LASERTRACE_STATUS_OK.
 */
lasertrace_status lasertrace_caster_free(lasertrace_caster *caster);

/*
 Casts `ray_count` rays and writes to `hits`, `hit_count` of them, what each meets first. The
 two numbers must be the same.

 Both sides of a triangle are met. Which of two triangles at the same distance is met
 depends on the 15 rays beside it, never on the number of threads. LIMITS.md says what may
 be lost at outlines of open meshes and within a 2^20th of the part's size of the origin.

 LASERTRACE_STATUS_ARGUMENT for a ray that is none (NaN, a direction of length 0); the
 message has its number, and all hits are LASERTRACE_NOTHING then.
 */
lasertrace_status lasertrace_closest_hits(const lasertrace_caster *caster,
                                          const lasertrace_ray *rays,
                                          size_t ray_count,
                                          lasertrace_surface_point *hits,
                                          size_t hit_count);

/*
 Casts `ray_count` rays and writes 1 to `hit` for each that meets something, else 0: just
 where lasertrace_closest_hits() finds something.
 */
lasertrace_status lasertrace_any_hits(const lasertrace_caster *caster,
                                      const lasertrace_ray *rays,
                                      size_t ray_count,
                                      uint8_t *hit,
                                      size_t hit_count);

/*
 Writes to `nearest` the place of the surface nearest to each of `point_count` points, three
 64-bit floats each (mm, within 1e12). Errors as of lasertrace_closest_hits().
 */
lasertrace_status lasertrace_nearest_points(const lasertrace_caster *caster,
                                            const double *points,
                                            size_t point_count,
                                            lasertrace_surface_point *nearest,
                                            size_t nearest_count);

/*
 Reads a scene from a file (TOML, see docs/manual.md) and the mesh it names.
 LASERTRACE_STATUS_INPUT for a mistake in one; the message names file, line and key.
 */
lasertrace_status lasertrace_scene_load(const char *path, lasertrace_scene **out);

/*
 The same of a scene given as text; files it names are sought in `folder`.
 */
lasertrace_status lasertrace_scene_parse(const char *toml,
                                         const char *folder,
                                         lasertrace_scene **out);

/*
 Frees a scene. NULL is nothing to free, and LASERTRACE_STATUS_OK.
 */
lasertrace_status lasertrace_scene_free(lasertrace_scene *scene);

/*
 How large a scene's frames are and how many its scan has.
 */
lasertrace_status lasertrace_scene_size(const lasertrace_scene *scene, lasertrace_size *out);

/*
 Plans a scene and builds all that its frames share. `threads`: 0 for one a core, at most
 1024. LASERTRACE_STATUS_RESOURCES for too little memory.
 */
lasertrace_status lasertrace_simulation_new(const lasertrace_scene *scene,
                                            uint32_t threads,
                                            lasertrace_simulation **out);

/*
 Frees a simulation. NULL is nothing to free, and LASERTRACE_STATUS_OK.
 */
lasertrace_status lasertrace_simulation_free(lasertrace_simulation *simulation);

/*
 Takes `frame_count` frames from number `first_frame` on, many at once, and writes what of
 them is wanted. A frame depends on its number alone, and is to the byte that of
 `lasertrace render`. Flags are those of the frame by itself; a scan takes some back that
 its neighbours explain.

 `progress` may be NULL. If it stops, the status is LASERTRACE_STATUS_STOPPED, and frames
 that were not taken hold nothing: counts 0, depths INFINITY, profiles of
 LASERTRACE_PROFILE_NOTHING.
 */
lasertrace_status lasertrace_simulation_frames(const lasertrace_simulation *simulation,
                                               uint32_t first_frame,
                                               uint32_t frame_count,
                                               const lasertrace_frames *frames,
                                               lasertrace_progress progress,
                                               void *user);

/*
 What was wrong with the last call of this thread that failed, in UTF-8, with the name of
 the function before it; "" if none has. Lives until the next call of this thread that
 fails.
 */
const char *lasertrace_last_error(void);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* LASERTRACE_H */
