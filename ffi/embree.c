#include "embree.h"
#include <string.h>

uint32_t lt_header_version(void) { return RTC_VERSION; }

uint32_t lt_library_version(RTCDevice device) {
  return (uint32_t)rtcGetDeviceProperty(device, RTC_DEVICE_PROPERTY_VERSION);
}

RTCDevice lt_device_new(const char *config, uint32_t *error) {
  RTCDevice device = rtcNewDevice(config);
  *error = device ? RTC_ERROR_NONE : rtcGetDeviceError(NULL);
  return device;
}

void lt_device_on_error(RTCDevice device, RTCErrorFunction function, void *user) {
  rtcSetDeviceErrorFunction(device, function, user);
}

void lt_device_on_memory(RTCDevice device, RTCMemoryMonitorFunction function, void *user) {
  rtcSetDeviceMemoryMonitorFunction(device, function, user);
}

void lt_device_release(RTCDevice device) { rtcReleaseDevice(device); }

RTCScene lt_mesh_scene_new(RTCDevice device, bool robust, size_t vertices,
                           float **vertex_buffer, bool quads, size_t faces,
                           const uint32_t *index_buffer) {
  RTCScene scene = rtcNewScene(device);
  if (!scene) return NULL;
  /* Not COMPACT: with ROBUST, coherent 16-wide occlusion of Debian 12's 3.13.5
   * never returns on AVX-512. Not HIGH: ROBUST silently ignores it. */
  rtcSetSceneFlags(scene, robust ? RTC_SCENE_FLAG_ROBUST : RTC_SCENE_FLAG_NONE);
  rtcSetSceneBuildQuality(scene, RTC_BUILD_QUALITY_MEDIUM);
  RTCGeometry geometry = rtcNewGeometry(device,
      quads ? RTC_GEOMETRY_TYPE_QUAD : RTC_GEOMETRY_TYPE_TRIANGLE);
  if (!geometry) {
    rtcReleaseScene(scene);
    return NULL;
  }
  /* A vertex buffer that Embree allocates carries the padding it reads past the
   * end; indices need none. */
  *vertex_buffer = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0,
      RTC_FORMAT_FLOAT3, 3 * sizeof(float), vertices);
  if (!*vertex_buffer) {
    rtcReleaseGeometry(geometry);
    rtcReleaseScene(scene);
    return NULL;
  }
  rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0,
      quads ? RTC_FORMAT_UINT4 : RTC_FORMAT_UINT3, index_buffer, 0,
      (quads ? 6 : 3) * sizeof(uint32_t), faces);
  rtcAttachGeometryByID(scene, geometry, 0);
  rtcReleaseGeometry(geometry);
  return scene;
}

float *lt_mesh_scene_vertices(RTCScene scene) {
  return rtcGetGeometryBufferData(rtcGetGeometry(scene, 0), RTC_BUFFER_TYPE_VERTEX, 0);
}

void lt_mesh_scene_moved(RTCScene scene) {
  RTCGeometry geometry = rtcGetGeometry(scene, 0);
  /* Scenes of medium quality have one tree over all triangles, which is never refitted. */
  rtcSetSceneBuildQuality(scene, RTC_BUILD_QUALITY_LOW);
  rtcSetGeometryBuildQuality(geometry, RTC_BUILD_QUALITY_REFIT);
  rtcUpdateGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0);
}

void lt_scene_on_progress(RTCScene scene, RTCProgressMonitorFunction function, void *user) {
  rtcSetSceneProgressMonitorFunction(scene, function, user);
}

void lt_scene_commit(RTCScene scene) {
  rtcCommitGeometry(rtcGetGeometry(scene, 0));
  rtcCommitScene(scene);
}

void lt_scene_release(RTCScene scene) { rtcReleaseScene(scene); }

uint32_t lt_packet_width(RTCDevice device) {
  bool halves = !rtcGetDeviceProperty(device, RTC_DEVICE_PROPERTY_NATIVE_RAY16_SUPPORTED) &&
                rtcGetDeviceProperty(device, RTC_DEVICE_PROPERTY_NATIVE_RAY8_SUPPORTED);
  return halves ? 8 : 16;
}

#if RTC_VERSION_MAJOR >= 4

#define ARGUMENTS(kind, coherent)                                                    \
  struct RTC##kind##Arguments arguments;                                             \
  rtcInit##kind##Arguments(&arguments);                                              \
  if (coherent) arguments.flags = RTC_RAY_QUERY_FLAG_COHERENT
#define INTERSECT(n, valid, rays) rtcIntersect##n(valid, scene, rays, &arguments)
#define OCCLUDED(n, valid, rays) rtcOccluded##n(valid, scene, rays, &arguments)

#else

#define ARGUMENTS(kind, coherent)                                                    \
  struct RTCIntersectContext arguments;                                              \
  rtcInitIntersectContext(&arguments);                                               \
  if (coherent) arguments.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT
#define INTERSECT(n, valid, rays) rtcIntersect##n(valid, scene, &arguments, rays)
#define OCCLUDED(n, valid, rays) rtcOccluded##n(valid, scene, &arguments, rays)

#endif

/* Where 16 rays are more than a machine's vectors hold, Embree copies them into packets
 * of 8 one by one; done here it takes less. */
#define TAKE(field) memcpy(half.field, rays->field + first, sizeof half.field)
#define GIVE(field) memcpy(rays->field + first, half.field, sizeof half.field)
#define TAKE_RAYS(r)                                                                 \
  TAKE(r org_x), TAKE(r org_y), TAKE(r org_z), TAKE(r tnear), TAKE(r dir_x),         \
      TAKE(r dir_y), TAKE(r dir_z), TAKE(r time), TAKE(r tfar), TAKE(r mask),        \
      TAKE(r id), TAKE(r flags)

static bool any_of_eight(const int *valid) {
  int any = 0;
  for (int i = 0; i < 8; ++i) any |= valid[i];
  return any;
}

void lt_intersect16(RTCScene scene, bool coherent, uint32_t width, const int *valid,
                    struct RTCRayHit16 *rays) {
  ARGUMENTS(Intersect, coherent);
  if (width == 16) {
    INTERSECT(16, valid, rays);
    return;
  }
  for (int first = 0; first < 16; first += 8) {
    if (!any_of_eight(valid + first)) continue;
    struct RTCRayHit8 half;
    TAKE_RAYS(ray.);
    TAKE(hit.geomID);
    INTERSECT(8, valid + first, &half);
    GIVE(ray.tfar), GIVE(hit.Ng_x), GIVE(hit.Ng_y), GIVE(hit.Ng_z), GIVE(hit.u);
    GIVE(hit.v), GIVE(hit.primID), GIVE(hit.geomID);
  }
}

void lt_occluded16(RTCScene scene, bool coherent, uint32_t width, const int *valid,
                   struct RTCRay16 *rays) {
  ARGUMENTS(Occluded, coherent);
  if (width == 16) {
    OCCLUDED(16, valid, rays);
    return;
  }
  for (int first = 0; first < 16; first += 8) {
    if (!any_of_eight(valid + first)) continue;
    struct RTCRay8 half;
    TAKE_RAYS();
    OCCLUDED(8, valid + first, &half);
    GIVE(tfar);
  }
}

#if RTC_VERSION_MAJOR >= 4

void lt_intersect1(RTCScene scene, struct RTCRayHit *ray) {
  rtcIntersect1(scene, ray, NULL);
}

void lt_occluded1(RTCScene scene, struct RTCRay *ray) {
  rtcOccluded1(scene, ray, NULL);
}

#else

void lt_intersect1(RTCScene scene, struct RTCRayHit *ray) {
  ARGUMENTS(Intersect, false);
  rtcIntersect1(scene, &arguments, ray);
}

void lt_occluded1(RTCScene scene, struct RTCRay *ray) {
  ARGUMENTS(Occluded, false);
  rtcOccluded1(scene, &arguments, ray);
}

#endif

void lt_point_query(RTCScene scene, struct RTCPointQuery *query,
                    RTCPointQueryFunction visit, void *user) {
  struct RTCPointQueryContext context;
  rtcInitPointQueryContext(&context);
  rtcPointQuery(scene, query, &context, visit, user);
}
