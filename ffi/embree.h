/* lasertrace's own narrow C API over whichever Embree is installed: 4.x (Debian
 * 13 ships 4.3) or 3.13 (Debian 12). Rust binds to this header, so it sees one
 * API, and the layout of every struct is that of the library that is linked.
 * Functions that can fail return 0 or NULL and leave the reason with the
 * device's error function. */
#ifndef LASERTRACE_EMBREE_H
#define LASERTRACE_EMBREE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#elif __has_include(<embree3/rtcore.h>)
#include <embree3/rtcore.h>
#else
#error "LASERTRACE_NO_EMBREE"
#endif

#if RTC_VERSION < 31300
#error "LASERTRACE_OLD_EMBREE"
#endif

/* geomID of a ray that met nothing (a cast macro in Embree's headers). */
enum { LT_NO_GEOMETRY = RTC_INVALID_GEOMETRY_ID };

/* RTC_VERSION of the header this was compiled against, e.g. 31305 = 3.13.5. */
uint32_t lt_header_version(void);
/* The same of the library that is loaded. */
uint32_t lt_library_version(RTCDevice device);

/* NULL if Embree cannot start; *error then holds the RTCError. */
RTCDevice lt_device_new(const char *config, uint32_t *error);
void lt_device_on_error(RTCDevice device, RTCErrorFunction function, void *user);
/* Calls `function` with every change of the memory the device holds, bytes. */
void lt_device_on_memory(RTCDevice device, RTCMemoryMonitorFunction function, void *user);
void lt_device_release(RTCDevice device);

/* A medium-quality scene, robust if so asked, of one mesh whose vertices (three floats
 * each) are still to be filled in, and whose faces stay the caller's for as long as the
 * scene lives: triangles of three indices each, or quads of four and two numbers that
 * are not read. */
RTCScene lt_mesh_scene_new(RTCDevice device, bool robust, size_t vertices,
                           float **vertex_buffer, bool quads, size_t faces,
                           const uint32_t *index_buffer);
/* Vertices of the mesh of a scene, to be overwritten, or NULL. */
float *lt_mesh_scene_vertices(RTCScene scene);
/* Marks the vertices as moved. The next commit refits the hierarchy; the first such commit builds
 * it in the form that can be refitted. */
void lt_mesh_scene_moved(RTCScene scene);
/* Calls `function` from any thread with the share done (0 to 1, not in order) while
 * the scene is committed; if it returns false, that ends with RTC_ERROR_CANCELLED. */
void lt_scene_on_progress(RTCScene scene, RTCProgressMonitorFunction function, void *user);
void lt_scene_commit(RTCScene scene);
void lt_scene_release(RTCScene scene);

/* Rays that this machine traces together, 16 or 8. */
uint32_t lt_packet_width(RTCDevice device);
/* 16 rays, closest hit and any hit, `width` of them together; `coherent`
 * says that they run side by side. `valid` holds -1 for a ray to be traced and 0 for one to be left out;
 * all pointers are 64-byte aligned. */
void lt_intersect16(RTCScene scene, bool coherent, uint32_t width, const int *valid,
                    struct RTCRayHit16 *rays);
void lt_occluded16(RTCScene scene, bool coherent, uint32_t width, const int *valid,
                   struct RTCRay16 *rays);
/* One ray; 16-byte aligned. */
void lt_intersect1(RTCScene scene, struct RTCRayHit *ray);
void lt_occluded1(RTCScene scene, struct RTCRay *ray);

/* Calls `visit` for each triangle that may lie within query->radius. */
void lt_point_query(RTCScene scene, struct RTCPointQuery *query,
                    RTCPointQueryFunction visit, void *user);

#endif
